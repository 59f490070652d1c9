"""The compiled CPU step."""
