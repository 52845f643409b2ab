"""The chain of `balance run`: what a campaign holds, which steps that allows, and their execution."""
