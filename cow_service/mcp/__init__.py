"""Tools of the Model Context Protocol: `simulate` and `answer`, built on the SDK.

inputs      arguments of the tools, and the request that they become
images      an image as a caller names it
progress    the job of a call: awaited, its progress reported, canceled with the call
results     what a tool returns as structured content
text        the same as text
pictures    the same as pictures
errors      errors as text from which a model can correct its call
server      the tools and resources of the protocol
backends    the server or service that does the work
transport   stdio and HTTP
"""
