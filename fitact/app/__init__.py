"""Page in the browser for the whole job: a file on disk to the report, without a terminal.

Takes files and clicks, and gives folders that the command line made: the server runs `fitact` and shows what it writes.
"""
