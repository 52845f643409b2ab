"""What a campaign consists of: the rig as declared and the runs as recorded."""
