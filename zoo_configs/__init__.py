"""RL Zoo configurations for the algorithms of this package."""
