"""Correction models: what they are fitted to, how they predict, and how their size is chosen."""
