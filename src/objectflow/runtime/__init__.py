"""Where work runs: devices, pools of processes, Ray, and silenced libraries."""
