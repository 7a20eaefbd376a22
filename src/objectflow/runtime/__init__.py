"""Execution: devices, pools of processes and Ray actors, and silencing of libraries."""
