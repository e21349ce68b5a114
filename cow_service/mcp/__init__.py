"""Tools of the Model Context Protocol: `simulate` and `answer`, by the SDK, for whoever speaks the protocol.

inputs      what a tool takes, and what becomes of it for the SDK
images      an image as a caller names it
progress    a job that is waited for, told of, and ended with its call
results     what a tool returns as data
words       the same as text
pictures    the same as pictures
failures    errors as text from which a model can do better
server      the protocol's side of all that
"""
