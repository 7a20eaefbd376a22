"""Generated data sets: scenes to rows to shards, on any number of processes."""
