"""Choice of the kind of model by cross-validation."""

def better_kind(run):
    return None
