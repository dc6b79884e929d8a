"""Cache of compiled programs between processes: description of a call, of its environment, and the folder of entries.

Imports nothing else of hilbo. Only commands use it; a notebook's programs live as long as its process.
"""
