"""Many cases: lists, batches, one process a case with limits, the workflow engine, progress, summary, watch folder."""
