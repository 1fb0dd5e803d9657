"""Templates of the QA report."""
