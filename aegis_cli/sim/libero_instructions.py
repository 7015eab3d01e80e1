"""The instructions of LIBERO's tasks as in its data sets: one line per task, in order of number.

They tell which episodes of a data set belong to a task, even if LIBERO is not installed.
"""

from __future__ import annotations

_SPATIAL = """
pick up the black bowl between the plate and the ramekin and place it on the plate
pick up the black bowl next to the ramekin and place it on the plate
pick up the black bowl from table center and place it on the plate
pick up the black bowl on the cookie box and place it on the plate
pick up the black bowl in the top drawer of the wooden cabinet and place it on the plate
pick up the black bowl on the ramekin and place it on the plate
pick up the black bowl next to the cookie box and place it on the plate
pick up the black bowl on the stove and place it on the plate
pick up the black bowl next to the plate and place it on the plate
pick up the black bowl on the wooden cabinet and place it on the plate
"""

_OBJECT = """
pick up the alphabet soup and place it in the basket
pick up the cream cheese and place it in the basket
pick up the salad dressing and place it in the basket
pick up the bbq sauce and place it in the basket
pick up the ketchup and place it in the basket
pick up the tomato sauce and place it in the basket
pick up the butter and place it in the basket
pick up the milk and place it in the basket
pick up the chocolate pudding and place it in the basket
pick up the orange juice and place it in the basket
"""

_GOAL = """
open the middle drawer of the cabinet
put the bowl on the stove
put the wine bottle on top of the cabinet
open the top drawer and put the bowl inside
put the bowl on top of the cabinet
push the plate to the front of the stove
put the cream cheese in the bowl
turn on the stove
put the bowl on the plate
put the wine bottle on the rack
"""

_LONG = """
put both the alphabet soup and the tomato sauce in the basket
put both the cream cheese box and the butter in the basket
turn on the stove and put the moka pot on it
put the black bowl in the bottom drawer of the cabinet and close it
put the white mug on the left plate and put the yellow and white mug on the right plate
pick up the book and place it in the back compartment of the caddy
put the white mug on the plate and put the chocolate pudding to the right of the plate
put both the alphabet soup and the cream cheese box in the basket
put both moka pots on the stove
put the yellow and white mug in the microwave and close it
"""

_NINETY = """
close the top drawer of the cabinet
close the top drawer of the cabinet and put the black bowl on top of it
put the black bowl in the top drawer of the cabinet
put the butter at the back in the top drawer of the cabinet and close it
put the butter at the front in the top drawer of the cabinet and close it
put the chocolate pudding in the top drawer of the cabinet and close it
open the bottom drawer of the cabinet
open the top drawer of the cabinet
open the top drawer of the cabinet and put the bowl in it
put the black bowl on the plate
put the black bowl on top of the cabinet
open the top drawer of the cabinet
put the black bowl at the back on the plate
put the black bowl at the front on the plate
put the middle black bowl on the plate
put the middle black bowl on top of the cabinet
stack the black bowl at the front on the black bowl in the middle
stack the middle black bowl on the back black bowl
put the frying pan on the stove
put the moka pot on the stove
turn on the stove
turn on the stove and put the frying pan on it
close the bottom drawer of the cabinet
close the bottom drawer of the cabinet and open the top drawer
put the black bowl in the bottom drawer of the cabinet
put the black bowl on top of the cabinet
put the wine bottle in the bottom drawer of the cabinet
put the wine bottle on the wine rack
close the top drawer of the cabinet
put the black bowl in the top drawer of the cabinet
put the black bowl on the plate
put the black bowl on top of the cabinet
put the ketchup in the top drawer of the cabinet
close the microwave
put the yellow and white mug to the front of the white mug
open the microwave
put the white bowl on the plate
put the white bowl to the right of the plate
put the right moka pot on the stove
turn off the stove
put the frying pan on the cabinet shelf
put the frying pan on top of the cabinet
put the frying pan under the cabinet shelf
put the white bowl on top of the cabinet
turn on the stove
turn on the stove and put the frying pan on it
pick up the alphabet soup and put it in the basket
pick up the cream cheese box and put it in the basket
pick up the ketchup and put it in the basket
pick up the tomato sauce and put it in the basket
pick up the alphabet soup and put it in the basket
pick up the butter and put it in the basket
pick up the milk and put it in the basket
pick up the orange juice and put it in the basket
pick up the tomato sauce and put it in the basket
pick up the alphabet soup and put it in the tray
pick up the butter and put it in the tray
pick up the cream cheese and put it in the tray
pick up the ketchup and put it in the tray
pick up the tomato sauce and put it in the tray
pick up the black bowl on the left and put it in the tray
pick up the chocolate pudding and put it in the tray
pick up the salad dressing and put it in the tray
stack the left bowl on the right bowl and place them in the tray
stack the right bowl on the left bowl and place them in the tray
put the red mug on the left plate
put the red mug on the right plate
put the white mug on the left plate
put the yellow and white mug on the right plate
put the chocolate pudding to the left of the plate
put the chocolate pudding to the right of the plate
put the red mug on the plate
put the white mug on the plate
pick up the book and place it in the front compartment of the caddy
pick up the book and place it in the left compartment of the caddy
pick up the book and place it in the right compartment of the caddy
pick up the yellow and white mug and place it to the right of the caddy
pick up the book and place it in the back compartment of the caddy
pick up the book and place it in the front compartment of the caddy
pick up the book and place it in the left compartment of the caddy
pick up the book and place it in the right compartment of the caddy
pick up the book and place it in the front compartment of the caddy
pick up the book and place it in the left compartment of the caddy
pick up the book and place it in the right compartment of the caddy
pick up the red mug and place it to the right of the caddy
pick up the white mug and place it to the right of the caddy
pick up the book in the middle and place it on the cabinet shelf
pick up the book on the left and place it on top of the shelf
pick up the book on the right and place it on the cabinet shelf
pick up the book on the right and place it under the cabinet shelf
"""

# For each suite, in LIBERO's order.
INSTRUCTIONS: dict[str, tuple[str, ...]] = {
    "spatial": tuple(_SPATIAL.strip().splitlines()),
    "object": tuple(_OBJECT.strip().splitlines()),
    "goal": tuple(_GOAL.strip().splitlines()),
    "10": tuple(_LONG.strip().splitlines()),
    "90": tuple(_NINETY.strip().splitlines()),
}
