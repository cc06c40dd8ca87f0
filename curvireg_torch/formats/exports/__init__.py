"""Poses as other tools read them: ROS, M3T and ViSP."""
