"""The commands of `elastic`, a dataclass of options each; what they do is imported when they run."""
