"""Cohorts of many thousand cases that cost nothing: what the list, the engine, the batches and the overview cost."""
