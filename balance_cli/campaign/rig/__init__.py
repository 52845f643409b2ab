"""The rig as declared: geometry, its file and its checks."""
