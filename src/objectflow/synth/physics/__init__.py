"""Poses of every frame, by MuJoCo or Bullet."""
