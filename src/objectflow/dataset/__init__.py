"""Generated data sets: row format, shards and manifest, batches, targets and augmentation, checks and pictures."""
