"""
Training runs: what one is (``run``), which there are (``suites``, ``plan``), how they are executed (``executor``, with this
machine's processes or with Ray), and the folders that they leave (``results``).
"""
