"""
How much C-CHAIN PPO depends on β and on the size of its reference batch: what is trained (``runs``), what an iteration costs
(``costs``), and what is made of both (``tables``, ``picture``).
"""
