"""What `olpm-bench new` writes: an experiment and a representation, which run as they are and explain themselves.

They are ordinary files, checked as all others are; NAME and ``Example`` in them become the name that was asked for.
"""
