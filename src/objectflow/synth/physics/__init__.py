"""Object poses per frame, simulated by MuJoCo or Bullet."""
