"""What a person who suspects the loss of plasticity looks at: churn, the neural tangent kernel, the health of networks."""
