"""What the report and the paper figures draw."""
