"""The layers around the routes: order, ids, origins, logs, limits, authentication."""
