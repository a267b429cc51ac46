"""Foundations without physics: errors, ranges, pytrees, compilation, and files kept between runs."""
