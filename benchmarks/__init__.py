"""Measures the package; imports it, never the reverse."""
