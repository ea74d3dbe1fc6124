"""What churn reduction, the related methods and the monitors cost."""
