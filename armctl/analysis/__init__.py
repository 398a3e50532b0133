"""How well a run went: metrics, reports, plots, comparisons, ISO 9283."""
