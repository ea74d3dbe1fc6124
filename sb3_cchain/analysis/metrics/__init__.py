"""Measures of plasticity: pure functions of tensors. Functions that take a model are in the files of ``analysis`` above."""
