"""Experiments with arms and controllers: margins, tuning, identification, comparisons, studies and ISO 9283."""
