"""What tests share: made files, scenes, servers, clients and bodies, a folder for each kind.

A module that a child process runs is named in full: ``-m support.server.job_worker``, with
``PYTHONPATH`` of the folder above this one.
"""
