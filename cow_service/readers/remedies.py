"""What a caller can do if a reader finds no place or no direction; used at the end of its error messages."""

GIVE_DIRECTION = "Say it with `motion.direction` [dx, dy] in the request, in pixels, x right and y down."
GIVE_OBJECT = "Give its box under that name in `objects`."
GIVE_PLACE = "Say where it is with `grounding.point` [x, y] or `grounding.bbox` [x0, y0, x1, y1] in the request."
