"""A trained policy for others: in LeRobot's layout, with its model card, and on the hub."""
