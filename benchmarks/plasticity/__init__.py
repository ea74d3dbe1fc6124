"""
Churn, the neural tangent kernel and the networks over the tasks: what is trained (``runs``), which matrices are kept
(``snapshots``), and what is made of the results (``heat_maps``, ``page``).
"""
