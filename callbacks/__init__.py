"""SB3 callbacks that show what a table has learned."""
