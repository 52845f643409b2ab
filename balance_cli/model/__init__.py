"""The balance as a linear system: plate, torque shaft, effects and channels; responses, derivatives and modes."""
