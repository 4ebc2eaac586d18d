"""`tactile-cdma calibrate`: known loads ──▶ points ──▶ curves; cycles ──▶ dynamics; ──▶ file."""
