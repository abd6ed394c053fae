"""What could a measurement tell, before there is data?

Takes a circuit, a drive and channels with their noise; gives the Fisher information, the directions that it lacks, and
the changes to the measurement that would add them.
"""
