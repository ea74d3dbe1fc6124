"""
Base algorithms and their C-CHAIN variants outside the paper's suites: what is compared (``cases``), how a run is trained
(``training``), and what is made of the results (``tables``, ``picture``).
"""
