"""Commands that are ended at random moments, that share an output, or that find no room: nothing half, nothing left."""
