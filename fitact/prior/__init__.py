"""What is believed before there is data?

Takes medians, factors and published tables; gives distributions and their joint density in log-parameters.
"""
