"""Files on disk: atomic writing, images, JSON, locks and hashes."""
