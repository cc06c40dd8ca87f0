def spied(patch, owner, name):
    """The positional arguments of each call of ``owner.name``, which is called as before."""
    calls = []
    original = getattr(owner, name)

    def noted(*given, **how):
        calls.append(given)
        return original(*given, **how)

    patch.setattr(owner, name, noted)
    return calls
