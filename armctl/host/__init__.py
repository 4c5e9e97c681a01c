"""The daemon's socket API: JSON-RPC 2.0, one object a line, over a Unix socket.

`jsonrpc` is the wire, without I/O; `server` keeps the connections; `host` is the arm as all clients share it;
`methods` is what they can ask for. `armctl.client` is the other end.
"""
