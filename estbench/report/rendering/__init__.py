"""The robot as picture, video and live view."""
