"""One thin file a stage: load, call the maths, save, return findings."""
