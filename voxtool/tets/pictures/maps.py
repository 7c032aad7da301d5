"""Maps of colours, by their names.

Colours at equal distances, hexadecimal: viridis and inferno [Walt 2015], coolwarm [Moreland 2009],
turbo [Mikhailov 2019]. Between them a map is linear and at most 0.07 off the published one.
"""

MAPS = {
    "viridis": "440154 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725",
    "inferno": "000004 210c4a 57106e 8a226a bc3754 e45a31 f98e09 f9cb35 fcffa4",
    "coolwarm": "3b4cc0 6282ea 8db0fe b8d0f9 dddddd f5c4ad f49a7b de604d b40426",
    "turbo": "30123b 4559cb 3e9bfe 19d5cd 46f884 a4fc3c e1dd37 fea431 f05b12 c32503 7a0403",
    "gray": "000000 ffffff",
}
