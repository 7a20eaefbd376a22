"""Methods to compare against, one a file."""
