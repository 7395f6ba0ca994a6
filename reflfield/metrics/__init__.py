"""Metrics against photographs, held-out evaluation, plots, report."""
