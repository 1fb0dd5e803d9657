"""Pure: joint coordinates, contact, solvers, sweep, smoothing, the table."""
