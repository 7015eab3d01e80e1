"""Backbones, the action expert, flow matching, and the policy that they make."""
