"""True surfaces of simulated objects, and of the table and boxes they stand among: vertices, faces, albedo of each vertex; metres, z up."""
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from other_surroundings import unit

TABLE_ALBEDO = 0.3


def sheet(points, albedo, wraps=False):
    """A mesh of a grid of points (rows, columns, 3), whose last column meets the first if it wraps."""
    rows, columns = points.shape[:2]
    at = np.arange(rows * columns).reshape(rows, columns)
    if wraps:
        at = np.concatenate([at, at[:, :1]], 1)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    return points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), np.broadcast_to(albedo, (rows, columns)).ravel()


def merged(parts):
    vertices, faces, albedo, n = [], [], [], 0
    for v, f, a in parts:
        vertices.append(v)
        faces.append(f + n)
        albedo.append(a)
        n += len(v)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(albedo)


def turned(profile_r, z, theta, albedo):
    """A body round the z axis: radii (len(z), len(theta))."""
    points = np.stack([profile_r * np.cos(theta), profile_r * np.sin(theta), np.broadcast_to(z[:, None], profile_r.shape)], -1)
    return sheet(points, albedo, wraps=True)


def bumps(x, y, centres, radius, height):
    """Round bumps (negative: dents) at centres of a plane."""
    total = np.zeros(np.broadcast(x, y).shape)
    for cx, cy in centres:
        total = np.maximum(total, np.clip(1 - ((x - cx) ** 2 + (y - cy) ** 2) / radius**2, 0, None) ** 0.5)
    return height * total


def vase(random):
    z, theta = np.linspace(0, 0.24, 600), np.linspace(0, 2 * np.pi, 1500, endpoint=False)
    up = z[:, None] / 0.24
    r = 0.055 + 0.035 * np.sin(np.pi * np.clip(up * 1.15, 0, 1)) ** 1.2 - 0.012 * np.exp(-((up - 0.88) / 0.07) ** 2)
    belly = np.exp(-((up - 0.42) / 0.2) ** 4)
    r = r + 0.0008 * belly * np.cos(36 * (theta + 1.5 * up))
    around = theta * 0.08
    beads = [(0.08 * 2 * np.pi * i / 16, 0.172) for i in range(16)]
    r = r + bumps(around[None, :], z[:, None], beads, 0.005, 0.0015)
    albedo = np.where((np.abs(up - 0.62) < 0.05) | (np.abs(up - 0.17) < 0.03), 0.32, 0.7) * np.ones_like(theta)
    bottom_and_top = [turned(np.outer(np.linspace(1e-4, 1, 120), r[k]), np.full(120, z[k]), theta, albedo[k]) for k in (0, -1)]
    return merged([turned(r, z, theta, albedo), *bottom_and_top]), "round"


def wedges(x, y, random, pitch):
    """Wedges in rows, as a stylus leaves them: depth below the surface, positive."""
    depth = np.zeros_like(x)
    for row in np.arange(y.min() + pitch, y.max() - pitch / 2, pitch):
        for at in np.arange(x.min() + pitch, x.max() - pitch / 2, pitch * 0.75):
            turn = random.choice([0, np.pi / 2, np.pi / 4]) + random.normal(0, 0.1)
            length, deep = pitch * random.uniform(0.5, 0.9), random.uniform(0.0006, 0.0016)
            dx, dy = x - at - random.normal(0, 0.0005), y - row
            along, across = dx * np.cos(turn) + dy * np.sin(turn), -dx * np.sin(turn) + dy * np.cos(turn)
            share = np.clip((along + length / 2) / length, 0, 1) * (along < length / 2)
            depth = np.maximum(depth, deep * np.clip(share - np.abs(across) / (0.25 * length), 0, 1))
    return depth


def slab(front, x, y, thick, albedo, tilt, lift):
    """A slab whose front is a field of heights over x (columns) and y (rows), leant back by a tilt, degrees."""
    gx, gy = np.meshgrid(x, y)
    back_x, back_y = gx[:: len(y) - 1], gy[:: len(y) - 1]
    face = np.stack([gx, gy, front], -1)
    rim = np.concatenate([face[0], face[1:, -1], face[-1, -2::-1], face[-2:0:-1, 0]])
    behind = rim * [1, 1, 0] - [0, 0, thick]
    sides = np.stack([rim + (behind - rim) * s for s in np.linspace(0, 1, 60)])
    parts = [sheet(face, albedo), sheet(sides, float(np.mean(albedo)), wraps=True)]
    parts.append(sheet(np.stack([np.stack([back_x, back_y, np.full_like(back_x, -thick)], -1)])[0], float(np.mean(albedo))))
    v, f, a = merged(parts)
    v = Rotation.from_euler("x", tilt, degrees=True).apply(v)
    v[:, 2] += lift - v[:, 2].min()
    return v, f, a


def ornament(x, y):
    """Painted tones of a plane, -1 to 1: a grid of discs between stripes and lines, 2 to 10 mm wide."""
    at_x, at_y = np.mod(x, 0.024) - 0.012, np.mod(y, 0.048) - 0.012
    stripe = np.where(np.mod(y, 0.048) > 0.028, 0.6, 0.0)
    lines = (np.abs(np.mod(y, 0.048) - 0.038) < 0.001) | (np.abs(np.mod(x + y, 0.03) - 0.015) < 0.001)
    disc = np.clip((0.008 - np.hypot(at_x, at_y)) / 0.0004, 0, 1)
    return np.where(lines, -1.0, stripe) * (1 - disc) + disc * np.where(np.hypot(at_x, at_y) < 0.004, 1.0, -0.6)


def tablet(random, stained=0.0, painted=0.0):
    x, y = np.linspace(-0.075, 0.075, 420), np.linspace(-0.1, 0.1, 560)
    gx, gy = np.meshgrid(x, y)
    pillow = 0.012 * (1 - (gx / 0.085) ** 4) * (1 - (gy / 0.115) ** 4)
    stain = gaussian_filter(random.normal(size=gx.shape), 60)
    albedo = 0.55 * (1 + stained * stain / np.abs(stain).max()) * np.exp(painted * ornament(gx, gy))
    crack = 0.001 * np.exp(-((gx - 0.02 * np.sin(gy * 40) - 0.02) / 0.0008) ** 2)
    return slab(pillow - wedges(gx, gy, random, 0.016) - crack, x, y, 0.025, albedo, 65, 0.0), "front"


def gear(random):
    theta = np.linspace(0, 2 * np.pi, 2400, endpoint=False)
    tooth = np.clip(1.6 * np.cos(20 * theta), -1, 1)
    rim = 0.094 + 0.006 * tooth
    z = np.linspace(0, 0.05, 110)
    side = turned(np.broadcast_to(rim, (len(z), len(theta))), z, theta, 0.5)
    s = np.linspace(1, 1e-4, 260)[:, None]
    px, py = s * rim * np.cos(theta), s * rim * np.sin(theta)
    far = np.hypot(px, py)
    top = 0.05 + 0.012 * np.clip((0.032 - far) / 0.001, 0, 1) - 0.008 * np.clip((0.014 - far) / 0.001, 0, 1)
    top -= 0.004 * np.clip(1 - np.maximum(np.abs(far - 0.06) - 0.015, 0) / 0.002, 0, 1)
    angle = np.mod(np.arctan2(py, px), 2 * np.pi)
    for k in range(14):
        local, kind = angle - (2 * np.pi * k / 14 + 0.2), k % 3
        u, w = local * 0.083, far - 0.083
        strokes = [np.abs(u) < 0.0007, np.abs(u - 0.5 * w) < 0.0007, np.abs(np.hypot(u, w) - 0.003) < 0.0007]
        top -= 0.0008 * (strokes[kind] & (np.abs(w) < 0.004) & (np.abs(u) < 0.006))
    cap = sheet(np.stack([px, py, top], -1), 0.5, wraps=True)
    return merged([side, cap]), "above"


def tube(start, end, radius, albedo):
    axis = (end - start) / np.linalg.norm(end - start)
    across = unit(np.cross(axis, [0.3, 0.9, 0.1]))
    other = np.cross(axis, across)
    s, theta = np.linspace(0, 1, 140)[:, None, None], np.linspace(0, 2 * np.pi, 90, endpoint=False)[None, :, None]
    round_end = radius * np.sqrt(np.clip(1 - np.clip(np.abs(s - 0.5) * 2 - 0.85, 0, None) ** 2 / 0.15**2, 1e-6, 1))
    return sheet(start + s * (end - start) + round_end * (np.cos(theta) * across + np.sin(theta) * other), albedo, wraps=True)


def ball(centre, radius, albedo):
    z, theta = np.cos(np.linspace(np.pi, 0, 160)), np.linspace(0, 2 * np.pi, 300, endpoint=False)
    nose = 0.15 * radius * np.exp(-((theta - 4.7) / 0.25) ** 2) * np.exp(-(z[:, None] / 0.25) ** 2)
    v, f, a = turned(np.sqrt(np.clip(1 - z**2, 1e-9, 1))[:, None] * radius + nose, z * radius, theta, albedo)
    return v + centre, f, a


def figure(random):
    z, theta = np.linspace(0, 0.19, 480), np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    up = z[:, None] / 0.19
    r = 0.05 - 0.022 * np.sin(np.pi * np.clip((up - 0.1) / 0.9, 0, 1)) + 0.006 * np.exp(-((up - 0.85) / 0.12) ** 2)
    skirt = np.clip(1 - up / 0.6, 0, 1)
    r = r + 0.002 * skirt * np.cos(18 * theta + 3 * np.sin(5 * up)) + 0.0006 * np.exp(-((up - 0.7) / 0.1) ** 2) * np.cos(60 * up * np.pi)
    r = r * np.sqrt(np.clip((1.0 - up) / 0.06, 1e-6, 1))
    body = turned(r * (1 + 0.25 * np.cos(2 * theta)), z, theta, 0.65)
    head = ball(np.array([0, 0, 0.205]), 0.024, 0.65)
    hand = [np.array([side * 0.062, -0.02, 0.09]) for side in (-1, 1)]
    shoulder = [np.array([side * 0.03, 0.0, 0.165]) for side in (-1, 1)]
    arms = [tube(shoulder[k], hand[k], 0.0075, 0.65) for k in (0, 1)]
    return merged([body, head, *arms]), "round"


def bowl(random):
    """Deep and open: light goes from wall to wall. Flutes, a wavy line and a ring of beads inside, grooves outside."""
    theta = np.linspace(0, 2 * np.pi, 1600, endpoint=False)
    inner, lip, outer = np.linspace(1e-3, np.pi / 2, 420), np.linspace(0, np.pi, 60)[1:-1], np.linspace(np.pi / 2, 0.35, 420)
    # From the middle of the inside over the rim to the foot, about a centre as high as the rim.
    r = np.concatenate([0.08 * np.sin(inner), 0.084 - 0.004 * np.cos(lip), 0.088 * np.sin(outer)])
    z = np.concatenate([-0.08 * np.cos(inner), 0.004 * np.sin(lip), -0.088 * np.cos(outer)])
    polar = np.concatenate([inner, np.full(len(lip), np.pi / 2), outer])[:, None]
    is_inside, is_outside = np.arange(len(r))[:, None] < len(inner), np.arange(len(r))[:, None] >= len(r) - len(outer)
    height = 0.0007 * np.cos(28 * theta) * np.exp(-((polar - 0.62) / 0.2) ** 4)
    height += 0.0009 * np.exp(-((polar - 1.0 - 0.05 * np.sin(9 * theta)) * 0.08 / 0.0012) ** 2)
    beads = [(0.08 * 2 * np.pi * i / 22, 0.08 * 1.22) for i in range(22)]
    height += bumps(0.08 * theta[None, :], 0.08 * polar, beads, 0.004, 0.0013)
    grooves = 0.0006 * np.sin(polar * 60) * np.exp(-((polar - 1.05) / 0.25) ** 4)
    across = -(is_inside * height + is_outside * grooves)
    r, z = r[:, None] + across * np.sin(polar), z[:, None] - across * np.cos(polar)
    points = np.stack([r * np.cos(theta), r * np.sin(theta), np.broadcast_to(z - z.min(), r.shape)], -1)
    foot = turned(np.outer(np.linspace(1e-4, 1, 60), r[-1]), np.full(60, (z - z.min())[-1].mean()), theta, 0.6)
    return merged([sheet(points[::-1], 0.6, wraps=True), foot]), "above"


def chest(random):
    """Flat sides that meet in sharp edges, each with a raised frame, rosettes and carved strokes; another albedo for the lid."""
    parts, (wide, deep, high) = [], (0.15, 0.1, 0.11)
    sides = [(wide, high, 0, deep), (deep, high, 90, wide), (wide, high, 180, deep), (deep, high, 270, wide)]
    for across, up, turn, through in sides:
        x, y = np.linspace(-across / 2, across / 2, int(across / 0.0004)), np.linspace(0, up, int(up / 0.0004))
        gx, gy = np.meshgrid(x, y)
        inset = np.minimum(across / 2 - np.abs(gx), np.minimum(gy, up - gy))
        relief = -0.0015 * np.clip((inset - 0.012) / 0.0006, 0, 1)
        panel = inset > 0.016
        centres = [(cx, up / 2) for cx in np.arange(-across / 2 + 0.035, across / 2 - 0.03, 0.03)]
        relief += bumps(gx, gy, centres, 0.009, 0.0014) * (1 + 0.25 * np.cos(0.5e3 * np.pi * np.hypot(np.mod(gx, 0.03) - 0.015, gy - up / 2)))
        strokes = np.abs(np.mod(gx + 0.3 * gy * np.sign(np.sin(gy * 300)), 0.007) - 0.0035) < 0.0006
        relief -= 0.0007 * (strokes & panel & (np.abs(np.abs(gy - up / 2) - 0.022) < 0.006))
        points = np.stack([gx, np.full_like(gx, -through / 2) - relief, gy], -1) @ Rotation.from_euler("z", turn, degrees=True).as_matrix().T
        parts.append(sheet(points, 0.6))
    x, y = np.linspace(-wide / 2, wide / 2, 375), np.linspace(-deep / 2, deep / 2, 250)
    gx, gy = np.meshgrid(x, y)
    lid = high + 0.0012 * np.clip(np.sin(gx * 420) * np.sin(gy * 420), 0, 1) * (np.minimum(wide / 2 - np.abs(gx), deep / 2 - np.abs(gy)) > 0.012)
    parts.append(sheet(np.stack([gx, gy, lid], -1), 0.4))
    return merged(parts), "round"


def rock(random):
    """Rough: waves of many lengths, and chisel marks."""
    polar, theta = np.linspace(1e-3, np.pi - 0.25, 900), np.linspace(0, 2 * np.pi, 1600, endpoint=False)
    p, t = np.meshgrid(polar, theta, indexing="ij")
    d = np.stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)], -1)
    r = np.full(p.shape, 0.075)
    for length, height, n in ((0.09, 0.010, 6), (0.035, 0.003, 10), (0.012, 0.0007, 24), (0.007, 0.00035, 24)):
        for _ in range(n):
            k = unit(random.normal(size=3)) * 2 * np.pi * 0.075 / length
            r = r + height / np.sqrt(n) * np.sin(d @ k + random.uniform(0, 6.3))
    marks = np.clip(np.sin(60 * t + 8 * np.sin(9 * p)) - 0.8, 0, 1) * (np.abs(p - 1.3) < 0.25)
    r = r - 0.0028 * marks
    points = d * r[..., None] * [1, 0.85, 1.1]
    points[..., 2] -= points[..., 2].min()
    body = sheet(points[::-1], 0.5, wraps=True)
    rim = points[-1]
    foot = sheet(np.stack([rim * [s, s, 1] for s in np.linspace(1, 1e-3, 40)])[::-1], 0.5, wraps=True)
    return merged([body, foot]), "round"


def mug(random):
    """Walls of 4 mm seen from both sides, a handle, signs in relief, grooves, a painted band."""
    theta = np.linspace(0, 2 * np.pi, 1400, endpoint=False)
    z = np.linspace(0, 0.12, 460)
    r_out = np.full((len(z), len(theta)), 0.046) + 0.002 * np.exp(-((z[:, None] - 0.004) / 0.004) ** 2)
    emboss = np.zeros((len(z), len(theta)))
    for k in range(12):
        c = 2 * np.pi * (k + 0.5) / 12
        u = (np.mod(theta - c + np.pi, 2 * np.pi) - np.pi)[None, :] * 0.046
        w = z[:, None] - 0.062
        ring = np.abs(np.hypot(u, w) - 0.007) < 0.0011
        cross = ((np.abs(u) < 0.001) | (np.abs(w) < 0.001)) & (np.hypot(u, w) < 0.009)
        diamond = np.abs(np.abs(u) + np.abs(w) - 0.008) < 0.0013
        emboss = np.maximum(emboss, 0.0009 * [ring, cross, diamond][k % 3])
    emboss = gaussian_filter(emboss, (1.5, 1.5), mode=("nearest", "wrap"))
    emboss += 0.0005 * (np.sin(z * 2 * np.pi / 0.004) * np.exp(-((z - 0.1) / 0.008) ** 4))[:, None]
    albedo = np.where(np.abs(z - 0.025) < 0.008, 0.3, 0.6)[:, None] * np.ones((1, len(theta)))
    outer = turned(r_out + emboss, z, theta, albedo)
    lip = np.linspace(0, np.pi, 30)
    inner_z = np.linspace(0.12, 0.006, 300)
    lip_part = turned((0.044 + 0.002 * np.cos(lip))[:, None] * np.ones((1, len(theta))), 0.12 + 0.002 * np.sin(lip), theta, 0.6)
    inside = turned(np.full((300, len(theta)), 0.042), inner_z, theta, 0.6)
    floor = turned(np.linspace(0.042, 1e-4, 100)[:, None] * np.ones((1, len(theta))), np.full(100, 0.006), theta, 0.6)
    along, about = np.linspace(-1.9, 1.9, 200)[:, None], np.linspace(0, 2 * np.pi, 90, endpoint=False)
    across = np.stack(np.broadcast_arrays(np.cos(about) * np.cos(along), np.sin(about), np.cos(about) * np.sin(along)), -1)
    middle = np.stack([0.052 + 0.027 * np.cos(along), np.zeros_like(along), 0.062 + 0.033 * np.sin(along)], -1)
    handle = middle + 0.0065 * across
    return merged([outer, lip_part, inside, floor, sheet(handle, 0.6, wraps=True)]), "round"


def medal(random):
    """Flat, on the table: 9 mm high, a relief of tenths of millimetres."""
    theta = np.linspace(0, 2 * np.pi, 1800, endpoint=False)
    far = np.linspace(0.1, 1e-4, 520)
    fr, th = np.meshgrid(far, theta, indexing="ij")
    x, y = fr * np.cos(th), fr * np.sin(th)
    top = np.full(fr.shape, 0.009) + 0.0012 * np.clip((fr - 0.092) / 0.0008, 0, 1)
    for _ in range(60):
        k = random.normal(size=2) * 2 * np.pi / 0.02
        top += 0.00006 * np.sin(x * k[0] + y * k[1] + random.uniform(0, 6.3)) * (fr < 0.085)
    face = 0.004 * np.clip(1 - (x / 0.045) ** 2 - (y / 0.055) ** 2, 0, None) ** 0.7
    top += face + 0.0006 * np.sin(np.hypot(x, y + 0.02) * 2 * np.pi / 0.006) * (face > 0.0005)
    top += 0.0005 * (np.abs(np.mod(th, 2 * np.pi / 40) - np.pi / 40) < 0.02) * ((fr > 0.07) & (fr < 0.088))
    cap = sheet(np.stack([x, y, top], -1), 0.6, wraps=True)
    side = sheet(np.stack([np.stack([x[0], y[0], top[0] * s], -1) for s in np.linspace(0, 1, 40)]), 0.6, wraps=True)
    return merged([side, cap]), "above"


OBJECTS = {
    "rock": rock,
    "mug": mug,
    "medal": medal,
    "bowl": bowl,
    "chest": chest,
    "vase": vase,
    "tablet": tablet,
    "stained": lambda random: tablet(random, stained=0.12),
    "painted": lambda random: tablet(random, painted=0.35),
    "gear": gear,
    "figure": figure,
}


def box(centre, size, turn, albedo):
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)]) * size / 2
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [1, 5, 7], [1, 7, 3], [0, 2, 6], [0, 6, 4]])
    corners = Rotation.from_euler("z", turn).apply(corners) + centre
    # Corners of its own for every face, so that edges stay sharp.
    return corners[faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), np.full(36, albedo)


def surroundings(random):
    table = np.array([[-0.8, -0.8, 0], [0.8, -0.8, 0], [0.8, 0.8, 0], [-0.8, 0.8, 0]])
    parts = [(table, np.array([[0, 1, 2], [0, 2, 3]]), np.full(4, TABLE_ALBEDO))]
    for k in range(9):
        angle, far = 2 * np.pi * (k + random.uniform(0, 0.6)) / 9, random.uniform(0.3, 0.65)
        size = random.uniform([0.06, 0.06, 0.03], [0.14, 0.14, 0.12])
        parts.append(box(np.array([far * np.cos(angle), far * np.sin(angle), 0]), size, random.uniform(0, 3), random.uniform(0.25, 0.5)))
    return merged(parts)
