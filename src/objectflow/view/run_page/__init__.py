"""The parts of a run's report page: tables, strips of frames, trajectory plots and models."""
