"""Generation of data sets: from scenes to rows to shards, with any number of processes."""
