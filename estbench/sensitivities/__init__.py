"""Sensitivity: how much each number that a filter believes, or that the robot has, matters."""
