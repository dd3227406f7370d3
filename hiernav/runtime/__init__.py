"""What runs on the robot: the loop, the estimator, the guard, the policies. No torch, no privilege required."""
