"""What every method shares about a pair: matches, registration, likelihood, the camera's motion."""
