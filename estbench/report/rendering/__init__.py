"""Pictures, videos and the live view of the robot."""
