"""
Continual supervised learning, as in Appendix A.4 of the C-CHAIN paper: what is learned (``images``, ``tasks``), how
(``learner``, ``training``), and what is made of the results (``tables``, ``picture``). No algorithm of Stable-Baselines3
is involved.
"""
