"""Programs kept between processes, so that what was traced yesterday is not traced again: what a call is in words, what
surrounds it, and the folder of entries.

Imports nothing of hilbo. Only commands use it; a notebook's programs live as long as its process.
"""
