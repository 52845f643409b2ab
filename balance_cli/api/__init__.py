"""The functions of `import balance_cli as bal`: each wraps one step, and takes paths or objects."""
