"""Linear velocity of the trunk from IMU, joint encoders and the previous joint targets."""
