"""A room, a robot and a log: physically simulated recordings with their truth.

It shares the nouns with the rest of the package, never a stage's model: what it writes can
therefore be used to judge the stages.
"""
