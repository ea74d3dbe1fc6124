"""Is the doctor right? Its findings in models that are healthy, and in models that bad settings have made sick."""
