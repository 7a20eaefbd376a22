"""Contents and appearance of generated scenes."""
