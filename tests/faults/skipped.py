"""What a row raises where the machine lacks what it needs."""


class Skipped(Exception):
    """Says what is lacking."""
