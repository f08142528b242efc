"""This room measures how fast the library is, beside bare torch and beside other libraries."""
