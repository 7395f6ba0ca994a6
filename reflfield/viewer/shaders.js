// The field in GLSL: what reflfield/field/half_vector.py, evaluation.py and indirect_light.py
// compute, for each of the four texels around a fragment; their samples are blended.
//
// Nothing is blended before the model is evaluated, since neighbours have frames of their own
// and may belong to different clusters; and nothing is summed in the transformed domain but
// what the model itself sums there. Tables are read through the interpolation of textures, which
// is the multilinear one of the models.

const VERTEX = `#version 300 es
layout(location = 0) in vec3 a_position;
layout(location = 1) in vec2 a_uv;
layout(location = 2) in float a_moved;
uniform mat4 u_clip;
out vec3 v_position;
out vec2 v_uv;
out float v_moved;
invariant gl_Position;
void main() {
  v_position = a_position;
  v_uv = a_uv;
  v_moved = a_moved;
  gl_Position = u_clip * vec4(a_position, 1.0);
}`;

const DEPTH_ONLY = `#version 300 es
precision mediump float;
void main() {}`;

// The surface behind the nearest one.
const DEPTH_BEHIND = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D u_nearest;
void main() {
  float nearest = texelFetch(u_nearest, ivec2(gl_FragCoord.xy), 0).r;
  if (gl_FragCoord.z <= nearest + 1e-6) discard;   // 24 bits of depth are 6e-8
}`;

// Half way between the nearest surface and the one behind it, at most a share of the object's
// radius behind the nearest.
const DEPTH_BETWEEN = `#version 300 es
precision highp float;
precision highp sampler2D;
const float MOST = 0.05;
uniform sampler2D u_nearest;
uniform sampler2D u_behind;
uniform vec2 u_range;        // distances of depths 0 and 1
uniform bool u_is_parallel;
float distance_of(float depth) {
  if (u_is_parallel) return mix(u_range.x, u_range.y, depth);
  return u_range.x * u_range.y / mix(u_range.y, u_range.x, depth);
}
float depth_of(float distance) {
  float share = (distance - u_range.x) / (u_range.y - u_range.x);
  return u_is_parallel ? share : share * u_range.y / distance;
}
void main() {
  ivec2 place = ivec2(gl_FragCoord.xy);
  float nearest = distance_of(texelFetch(u_nearest, place, 0).r);
  float behind = distance_of(texelFetch(u_behind, place, 0).r);
  gl_FragDepth = depth_of(min(0.5 * (nearest + behind), nearest + MOST));
}`;

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
precision highp sampler3D;
precision highp sampler2DArrayShadow;
const float HORIZON = 0.08;      // hemisphere.HORIZON_SOFTNESS
float softened_cosine(float z) {
  float foot = clamp(z, -HORIZON, HORIZON) + HORIZON;
  return z >= HORIZON ? z : foot * foot / (4.0 * HORIZON);
}
vec3 turned(vec4 q, vec3 v) {
  return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v);
}
uniform sampler2DArray u_texels;
`;

// Sample of the texel at pixel p for local directions v and l; layer 0: diffuse colour, 1: weights.
const HALF_VECTOR = `
const float KNEE = radians(4.0);
const float REACH = asinh(radians(90.0) / KNEE);
const float LEAST = 0.05;
uniform sampler3D u_lobes;       // 33 x 33 nodes of h, 6 of the difference angle for each lobe
uniform sampler2DArray u_skews;  // 6 rings of the half vector, 6 of the difference angle
uniform sampler3D u_diffuse;     // cosines of light and view, phase
vec3 model_sample(ivec2 p, vec3 v, vec3 l) {
  float cosine = softened_cosine(l.z);
  if (cosine == 0.0) return vec3(0.0);
  vec3 h = (l + v) * inversesqrt(dot(l + v, l + v) + 1e-12);
  h.z = max(h.z, 0.0);
  float cos_difference = clamp(dot(l, h), 0.0, 1.0);
  float radius = asinh(acos(min(h.z, 1.0)) / KNEE) / REACH;
  vec2 square = h.xy * radius / (length(h.xy) + 1e-12);
  vec2 at = (clamp((square + 1.0) * 16.0, 0.0, 32.0) + 0.5) / 33.0;
  float layer = clamp(acos(cos_difference) * (5.0 / radians(90.0)), 0.0, 5.0) + 0.5;
  vec2 ring = vec2(radius * 5.0 + 0.5, layer) / 6.0;
  float sines = dot(h.xy, h.xy) * (1.0 - cos_difference * cos_difference);
  float turn = min((l.z - v.z) * (l.z - v.z) / (2.0 * sines + 1e-12) - 1.0, 1.0);
  float cos_light = clamp(l.z, 0.0, 1.0), cos_view = clamp(v.z, LEAST, 1.0);
  vec3 node = vec3(cos_light * 5.0, cos_view * 5.0, (1.0 - cos_difference) * 3.0) + 0.5;
  float base = texture(u_diffuse, node / vec3(6.0, 6.0, 4.0)).r;
  float raised = max(cos_light, LEAST);
  float spread = 1.0 / (raised + cos_view - raised * cos_view);
  vec4 weights = texelFetch(u_texels, ivec3(p, 1), 0);
  vec3 lobes = vec3(0.0);
  for (int k = 0; k < N_LOBES; k++) {
    float z = (float(6 * k) + layer) / float(6 * N_LOBES);
    vec3 skew = 1.0 + turn * texture(u_skews, vec3(ring, float(k))).rgb;
    lobes += weights[k] * skew * texture(u_lobes, vec3(at, z)).rgb;
  }
  return cosine * (texelFetch(u_texels, ivec3(p, 0), 0).rgb * base + spread * lobes);
}
vec3 model_weights(ivec2 p) {
  return texelFetch(u_texels, ivec3(p, 1), 0).rgb;
}`;

// The first number of the layers is the cluster, then follow the coefficients. Along x and y of
// the table: tiles of light nodes, one for each cluster, row of view nodes and function; along
// z: columns of view nodes.
const CLUSTERED = `
uniform sampler3D u_nodes;
const float QUARTER_PI = radians(45.0);
vec2 square_from(vec3 d) {
  float radius = sqrt(max(1.0 - max(d.z, 0.0), 0.0));
  if (abs(d.x) < 1e-12 && abs(d.y) < 1e-12) return vec2(0.0);
  if (abs(d.x) >= abs(d.y)) {
    float u = d.x >= 0.0 ? radius : -radius;
    return vec2(u, u * atan(d.y / d.x) / QUARTER_PI);
  }
  float w = d.y >= 0.0 ? radius : -radius;
  return vec2(w * atan(d.x / d.y) / QUARTER_PI, w);
}
vec2 node_position(vec3 d, int side) {
  if (side == 1) return vec2(0.0);
  return clamp((square_from(d) + 1.0) * 0.5 * float(side - 1), 0.0, float(side - 1));
}
vec3 node_values(int tile, vec2 light, float view_column) {
  ivec2 corner = ivec2(tile % TILES_ACROSS, tile / TILES_ACROSS) * LIGHT_SIDE;
  vec3 at = vec3(vec2(corner) + light, view_column) + 0.5;
  return texture(u_nodes, at / vec3(textureSize(u_nodes, 0))).rgb;
}
vec3 model_sample(ivec2 p, vec3 v, vec3 l) {
  float cosine = LIGHT_SIDE == 1 ? 1.0 : softened_cosine(l.z);
  if (cosine == 0.0) return vec3(0.0);
  vec2 view = node_position(v, VIEW_SIDE), light = node_position(l, LIGHT_SIDE);
  int row = min(int(view.y), max(VIEW_SIDE - 2, 0));
  float share = view.y - float(row);
  vec4 some = texelFetch(u_texels, ivec3(p, 0), 0);
  int first = (int(some.r + 0.5) * VIEW_SIDE + row) * N_FUNCTIONS;
  vec3 total = vec3(0.0);
  for (int k = 0; k < N_FUNCTIONS; k++) {
    if (k > 0 && k % 4 == 0) some = texelFetch(u_texels, ivec3(p, k / 4), 0);
    vec3 value = node_values(first + k, light, view.x);
    if (VIEW_SIDE > 1) {
      value = mix(value, node_values(first + N_FUNCTIONS + k, light, view.x), share);
    }
    total += (k == 0 ? 1.0 : some[k % 4]) * value;
  }
  return cosine * from_domain(total);
}
vec3 model_weights(ivec2 p) {
  vec4 some = texelFetch(u_texels, ivec3(p, 0), 0);
  return 0.5 + 0.25 * some.gba;
}`;

// Indirect light: functions of the lamp's direction in the world, read once for a fragment.
const INDIRECT = `
uniform sampler2DArray u_sphere;     // columns of azimuth, rows of the polar angle; functions
uniform sampler2DArray u_indirect;   // coefficients
vec3 shone[N_INDIRECT];
vec2 sphere_place(vec3 d) {
  vec2 size = vec2(textureSize(u_sphere, 0).xy);
  float column = atan(d.y, d.x) / radians(360.0) * size.x + 0.5;
  float row = atan(length(d.xy), d.z) / radians(180.0) * (size.y - 1.0) + 0.5;
  return vec2(column, row) / size;
}
void read_indirect(vec3 d) {
  vec2 at = sphere_place(d);
  for (int k = 0; k < N_INDIRECT; k++) shone[k] = texture(u_sphere, vec3(at, float(k))).rgb;
}
vec3 indirect_sample(ivec2 p) {
  vec3 total = shone[0];
  for (int layer = 0; 4 * layer < N_INDIRECT - 1; layer++) {
    vec4 some = texelFetch(u_indirect, ivec3(p, layer), 0);
    for (int i = 0; i < 4 && 4 * layer + i < N_INDIRECT - 1; i++) {
      total += some[i] * shone[4 * layer + i + 1];
    }
  }
  return from_domain(total);
}`;

// POWER is that of the inverse transform; a product, since pow() of a GPU is inexact.
const DOMAIN = `
vec3 from_domain(vec3 root) {
  vec3 value = max(root, 0.0);
  return POWER == 3 ? value * value * value : POWER == 2 ? value * value : value;
}`;

const SHADING = `
in vec3 v_position;
in vec2 v_uv;
in float v_moved;
out vec4 o_colour;
uniform sampler2D u_frames;          // quaternions, 0 where a pixel has no texel
uniform sampler2DArrayShadow u_shadows;
uniform ivec2 u_atlas;
uniform vec3 u_eye;
uniform vec4 u_parallel;             // direction to the viewer and 1, of a parallel projection
uniform float u_pixel;               // width of a pixel at distance 1 over that of a texel
uniform float u_cell;                // width of a ray's cell over that of a pixel
uniform int u_show;
uniform vec3 u_weight_scale;
uniform int u_n_lamps;
uniform vec4 u_lamp[MOST_LAMPS];     // position and 1, or direction and 0
uniform vec3 u_power[MOST_LAMPS];
uniform mat4 u_shadow_clip[MOST_LAMPS];
uniform bool u_casts[MOST_LAMPS];    // whether there is a shadow map
uniform sampler2D u_covered;
ivec2 tap_pixel[4];
float tap_weight[4];
vec4 tap_frame[4];

// The four texels around the fragment; those that do not exist get no weight.
void find_taps(float transition) {
  vec2 place = vec2(v_uv.x, 1.0 - v_uv.y) * vec2(u_atlas) - 0.5;
  place = clamp(place, vec2(0.0), vec2(u_atlas - 1));
  ivec2 lower = min(ivec2(place), max(u_atlas - 2, 0));
  vec2 share = (place - vec2(lower) - 0.5) / max(transition, 1e-6) + 0.5;
  share = clamp(share, 0.0, 1.0);
  float total = 0.0;
  for (int i = 0; i < 4; i++) {
    ivec2 step = ivec2(i & 1, i >> 1);
    tap_pixel[i] = min(lower + step, u_atlas - 1);
    tap_frame[i] = texelFetch(u_frames, tap_pixel[i], 0);
    vec2 part = mix(1.0 - share, share, vec2(step));
    tap_weight[i] = tap_frame[i] == vec4(0.0) ? 0.0 : part.x * part.y;
    total += tap_weight[i];
  }
  for (int i = 0; i < 4; i++) tap_weight[i] /= max(total, 1e-12);
}

// Share of the lamp's light that reaches the fragment; 1 where shadows are in the field.
float reached(int i, vec3 normal, vec3 light) {
  if (!TRACED) return 1.0;
  if (dot(normal, light) <= 0.0) return 0.0;
  if (!u_casts[i]) return 1.0;
  vec4 clip = u_shadow_clip[i] * vec4(v_position, 1.0);
  vec3 place = clip.xyz / clip.w * 0.5 + 0.5;
  return texture(u_shadows, vec4(place.xy, float(i), place.z - 1e-6));
}

vec3 lit_by(int i, vec3 normal, vec3 view) {
  vec3 towards = u_lamp[i].xyz - u_lamp[i].w * v_position;
  float distance = max(length(towards), 1e-9);
  vec3 light = u_lamp[i].w == 0.0 ? u_lamp[i].xyz : towards / distance;
  float share = reached(i, normal, light);
  vec3 total = vec3(0.0);
  #ifdef N_INDIRECT
  if (share < 1.0) read_indirect(light);
  #endif
  for (int j = 0; j < 4; j++) {
    if (tap_weight[j] < 1e-4) continue;
    vec4 q = tap_frame[j];
    if (share > 0.0) {
      total += tap_weight[j] * share * model_sample(tap_pixel[j], turned(q, view), turned(q, light));
    }
    #ifdef N_INDIRECT
    if (share < 1.0) total += tap_weight[j] * (1.0 - share) * indirect_sample(tap_pixel[j]);
    #endif
  }
  return total * u_power[i] / (u_lamp[i].w == 0.0 ? 1.0 : distance * distance);
}

// Grey where a light comes from between the capture's lights, orange where from beyond them.
vec3 light_coverage(vec3 normal) {
  vec3 colour = vec3(0.0);
  for (int i = 0; i < u_n_lamps; i++) {
    vec3 light = normalize(u_lamp[i].xyz - u_lamp[i].w * v_position);
    vec2 size = vec2(textureSize(u_covered, 0));
    float column = fract(atan(light.y, light.x) / radians(360.0)) * size.x;
    float row = acos(clamp(light.z, -1.0, 1.0)) / radians(180.0) * (size.y - 1.0);
    ivec2 node = ivec2(mod(column + 0.5, size.x), row + 0.5);
    bool known = texelFetch(u_covered, node, 0).r > 0.0;
    vec3 shown = known ? vec3(0.75) : vec3(0.95, 0.5, 0.15);
    colour += shown * (0.35 + 0.65 * max(dot(normal, light), 0.0)) / float(u_n_lamps);
  }
  return colour;
}

// Blue where the surface lies inside of the hull, red where outside, lit from the viewer.
vec3 distance_to_hull(vec3 normal, vec3 view) {
  vec3 end = v_moved < 0.0 ? vec3(0.13, 0.4, 0.67) : vec3(0.7, 0.09, 0.17);
  return mix(vec3(0.93), end, abs(v_moved)) * (0.35 + 0.65 * dot(normal, view));
}

vec3 shown_value(vec3 normal, vec3 view) {
  if (u_show == 5) return distance_to_hull(normal, view);
  vec3 total = vec3(0.0);
  for (int j = 0; j < 4; j++) {
    if (tap_weight[j] == 0.0) continue;
    // The inverse of the frame's rotation gives its axes in the world.
    vec4 q = vec4(-tap_frame[j].xyz, tap_frame[j].w);
    vec3 value = u_show == 3 ? model_weights(tap_pixel[j]) * u_weight_scale
      : 0.5 + 0.5 * turned(q, u_show == 2 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 0.0, 1.0));
    total += tap_weight[j] * value;
  }
  return u_show == 4 ? light_coverage(normal) : total;
}

void main() {
  vec3 normal = normalize(cross(dFdx(v_position), dFdy(v_position)));
  vec3 towards = u_eye - v_position;
  float distance = length(towards);
  vec3 view = u_parallel.w == 1.0 ? u_parallel.xyz : towards / distance;
  if (dot(normal, view) < 0.0) normal = -normal;
  if (!gl_FrontFacing) {               // the inside of the surface is black
    o_colour = vec4(0.0, 0.0, 0.0, u_alpha);
    return;
  }
  float pixel = u_pixel * (u_parallel.w == 1.0 ? 1.0 : distance);
  find_taps(clamp(max(1.0 - pixel, u_cell * pixel), 0.0, 1.0));
  vec3 total = vec3(0.0);
  if (u_show > 0) {
    total = shown_value(normal, view);
  } else {
    for (int i = 0; i < u_n_lamps; i++) total += lit_by(i, normal, view);
  }
  o_colour = vec4(total, u_alpha);
}`;

// Before the field is there: the mesh with the colours of the preview, lit from the viewer.
const PREVIEW = `#version 300 es
precision highp float;
in vec3 v_position;
in vec2 v_uv;
out vec4 o_colour;
uniform sampler2D u_preview;
uniform vec3 u_eye;
void main() {
  vec3 normal = normalize(cross(dFdx(v_position), dFdy(v_position)));
  float facing = abs(dot(normal, normalize(u_eye - v_position)));
  vec3 colour = texture(u_preview, vec2(v_uv.x, 1.0 - v_uv.y)).rgb;
  o_colour = gl_FrontFacing ? vec4(colour * facing, 1.0) : vec4(0.0, 0.0, 0.0, 1.0);
}`;

const FULL_SCREEN = `#version 300 es
out vec2 v_place;
void main() {
  v_place = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
  gl_Position = vec4(v_place * 2.0 - 1.0, 0.0, 1.0);
}`;

// From the sum of images to the screen: mean, exposure, tone curve, sRGB, backdrop.
const PRESENT = `#version 300 es
precision highp float;
in vec2 v_place;
out vec4 o_colour;
uniform sampler2D u_image;
uniform float u_share;       // one over the number of images in the sum
uniform float u_exposure;    // 0: values are shown as they are
uniform int u_curve;
uniform vec3 u_backdrop;
vec3 encoded(vec3 linear) {
  vec3 x = clamp(linear, 0.0, 1.0);
  return mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}
// Straight to 0.6, then ever flatter to 1: highlights keep their colour and shape.
vec3 soft(vec3 x) {
  vec3 above = max(x - 0.6, 0.0);
  return min(x, 0.6) + 0.4 * above / (above + 0.4);
}
void main() {
  vec4 image = texture(u_image, v_place) * u_share;
  float covered = clamp(image.a, 0.0, 1.0);
  vec3 value = image.rgb / max(image.a, 1e-6);
  if (u_exposure > 0.0) {
    value *= u_exposure;
    value = encoded(u_curve == 1 ? soft(value) : value);
  }
  vec2 place = v_place - 0.5;
  vec3 backdrop = u_backdrop * (1.0 - 0.5 * dot(place, place));
  o_colour = vec4(mix(backdrop, value, covered), 1.0);
}`;

const ADD_UP = `#version 300 es
precision highp float;
in vec2 v_place;
out vec4 o_colour;
uniform sampler2D u_image;
void main() { o_colour = texture(u_image, v_place); }`;

// Fragment shader of a field: the numbers of its model are constants of the program.
function shadingOf(header, field, tilesAcross, mostLamps) {
  const constants = { POWER: header.power, TRACED: header.traced, MOST_LAMPS: mostLamps };
  if (header.model === "half_vector") {
    constants.N_LOBES = field.model.nLobes;
  } else {
    constants.N_FUNCTIONS = field.model.nFunctions;
    [constants.VIEW_SIDE, constants.LIGHT_SIDE] = header.sides;
    constants.TILES_ACROSS = tilesAcross;
  }
  if (field.indirect) constants.N_INDIRECT = field.indirect.nFunctions;
  const defines = Object.entries(constants).map(([name, value]) => `#define ${name} ${value}`);
  const [version, ...head] = HEAD.split("\n");
  return [
    version, ...defines, ...head, "uniform float u_alpha;", DOMAIN,
    header.model === "half_vector" ? HALF_VECTOR : CLUSTERED,
    field.indirect ? INDIRECT : "", SHADING,
  ].join("\n");
}
