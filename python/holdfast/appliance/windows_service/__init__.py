"""Services of Windows: installing them, and answering the service control manager.

`installation` and `host` require pywin32, so they are imported only by commands that need them.
"""
