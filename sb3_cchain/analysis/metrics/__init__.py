"""
Measures of plasticity, and of returns over a sequence of tasks: pure functions of tensors, arrays and tables. Functions that
take a model are in the files of ``analysis`` above.
"""
