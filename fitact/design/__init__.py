"""What should be measured, and how should the display be driven?

Takes a scene, with records or without; gives measurements and drives, ranked by what they achieve.
"""
