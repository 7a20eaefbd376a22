"""Tables of an evaluation: summaries, bootstrap intervals, breakdowns and text."""
