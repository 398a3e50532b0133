"""How a run went: reports, plots, pages and films."""
