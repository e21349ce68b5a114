"""Tools of the Model Context Protocol: `simulate` and `answer`, built on the SDK.

arguments   what the tools take, and the request that it becomes; errors from which a model can correct its call
results     what a tool returns: data, text and pictures
server      the tools and resources of the protocol
serving     the server or service that does the work; stdio and HTTP
"""
