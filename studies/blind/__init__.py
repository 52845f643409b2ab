"""Blind campaigns: a simulator that shares no code with balance_cli, and what the commands make of its files."""
