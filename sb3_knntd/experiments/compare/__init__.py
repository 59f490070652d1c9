"""This project's learners beside those of RL Zoo: the same runs for all, statistics over seeds, and a report."""
