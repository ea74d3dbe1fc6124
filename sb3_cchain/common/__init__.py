"""What C-CHAIN algorithms share: the wiring of churn reduction into Stable-Baselines3."""
