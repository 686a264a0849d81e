"""What the true robot does: its controller, its disturbance and its sensors."""
