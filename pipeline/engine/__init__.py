"""Runs any list of stages over cases; knows nothing of knees."""
