"""Files on disk: written whole or not at all, images, JSON, locks and hashes."""
