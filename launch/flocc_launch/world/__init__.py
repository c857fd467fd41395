"""A generated world: a town, robots that walk through it, and what their cameras and odometry see."""
