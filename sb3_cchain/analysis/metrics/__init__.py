"""Measures of plasticity: pure functions of tensors."""
