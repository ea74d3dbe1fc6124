"""
Tables, pictures and pages made from result folders. ``python -m benchmarks.report`` sets them beside the paper's numbers
(``paper_tables.csv``).
"""
