"""Rows, the meaning of their columns, and the tables, charts and cards that are made of them."""
