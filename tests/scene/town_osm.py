"""A town of three by three blocks as OpenStreetMap XML, made up."""

import math

LATITUDE_DEG, LONGITUDE_DEG = 50.0, 8.0
BLOCK_M = 110.0


class _Town:
    def __init__(self):
        self.lines, self.count = [], 0
        self.nodes, self.ways = [], []

    def node(self, x, y):
        self.count += 1
        latitude = LATITUDE_DEG + y / 111_200
        longitude = LONGITUDE_DEG + x / (111_320 * math.cos(math.radians(LATITUDE_DEG)))
        self.nodes.append(f'<node id="{self.count}" lat="{latitude:.7f}" lon="{longitude:.7f}"/>')
        return self.count

    def way(self, refs, **tags):
        ident = 1000 + len(self.ways)
        inside = "".join(f'<nd ref="{r}"/>' for r in refs) + tagged(tags)
        self.ways.append(f'<way id="{ident}">{inside}</way>')
        return ident

    def ring(self, x, y, width, height):
        corners = [self.node(*p) for p in ((x, y), (x + width, y), (x + width, y + height), (x, y + height))]
        return [*corners, corners[0]]


def tagged(tags):
    return "".join(f'<tag k="{k.replace("__", ":")}" v="{v}"/>' for k, v in tags.items())


def town_osm():
    """Streets, a building with a courtyard, three houses, a park with a pond and a car park."""
    town = _Town()
    grid = {(i, j): town.node((i - 1.5) * BLOCK_M, (j - 1.5) * BLOCK_M) for i in range(4) for j in range(4)}
    for i in range(4):
        kind = "secondary" if i == 1 else "residential"
        town.way([grid[i, j] for j in range(4)], highway=kind)
        town.way([grid[j, i] for j in range(4)], highway=kind)
    outer, inner = town.way(town.ring(-40, -40, 80, 80)), town.way(town.ring(-20, -20, 40, 40))
    town.way(town.ring(70, -40, 14, 12), building="house", building__levels="2")
    town.way(town.ring(70, 0, 14, 12), building="house")
    town.way(town.ring(100, -40, 14, 12), building="house", height="tall")
    town.way(town.ring(70, 70, 80, 80), leisure="park")
    town.way(town.ring(90, 90, 20, 15), natural="water")
    town.way(town.ring(-150, -40, 70, 60), amenity="parking")
    members = (
        f'<member type="way" ref="{outer}" role="outer"/><member type="way" ref="{inner}" role="inner"/>'
    )
    tags = tagged({"type": "multipolygon", "building": "yes", "height": "15 m"})
    relation = f'<relation id="9000">{members}{tags}</relation>'
    return "\n".join(['<osm version="0.6">', *town.nodes, *town.ways, relation, "</osm>"])
