"""From scores to tables: summaries, intervals, breakdowns and text."""
