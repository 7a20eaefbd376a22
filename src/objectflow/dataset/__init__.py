"""Generated data on disk: the row format, shards and their manifest, checks and pictures of them."""
