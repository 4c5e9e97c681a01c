"""The control process: a pure step, the loop that feeds it, and the process around both."""
