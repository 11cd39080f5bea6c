// What the GPU runs: points, lines of a width (WebGL's own are one pixel), triangles.
// Colours are sRGB bytes and are written as they are: nothing here is linear light.

/** From dark to bright, readable without colours: viridis. */
const RAMP = `const vec3 ramp[5] = vec3[5](
  vec3(0.267, 0.005, 0.329), vec3(0.230, 0.322, 0.546), vec3(0.128, 0.567, 0.551),
  vec3(0.369, 0.789, 0.383), vec3(0.993, 0.906, 0.144));

vec3 ramped(float share) {
  float t = clamp(share, 0.0, 1.0) * 4.0;
  int k = min(int(t), 3);
  return mix(ramp[k], ramp[k + 1], t - float(k));
}`;

const POINTS = `#version 300 es
layout(location = 0) in vec3 at;
layout(location = 1) in uint group;
layout(location = 2) in vec3 normal;
layout(location = 3) in uint residual;
uniform mat4 model, clip;
uniform vec3 origin, extent, eye, above, tint, outside, violation, steps[3];
uniform vec2 pixels, heights; // least and most of a point; of colour by height
uniform float size, shade;    // pixels at one metre; share of light that a slant surface loses
uniform int mode;
uniform sampler2D palette;
flat out vec3 colour;

${RAMP}
vec3 grouped() {
  if (group == 65535u) return outside;
  return texelFetch(palette, ivec2(int(group & 255u), int(group >> 8)), 0).rgb;
}

vec3 kept() {
  if (residual == 254u) return violation;
  if (residual > 250u) return outside;
  return residual <= 50u ? steps[0] : residual <= 100u ? steps[1] : steps[2];
}

void main() {
  vec4 world = model * vec4(origin + at * extent, 1.0);
  gl_Position = clip * world;
  gl_PointSize = clamp(size / max(gl_Position.w, 1e-6), pixels.x, pixels.y);
  vec3 turned = mat3(model) * normal;
  float light = 1.0 - shade * (1.0 - abs(dot(turned, normalize(eye - world.xyz))));
  if (mode == 1) colour = (turned + 1.0) * 0.5;
  else if (mode == 2) colour = light * grouped();
  else if (mode == 3) colour = kept();
  else if (mode == 4) colour = light * ramped((dot(world.xyz, above) - heights.x) / max(heights.y - heights.x, 1e-6));
  else colour = light * tint;
}`;

const POINT_COLOUR = `#version 300 es
precision mediump float;
flat in vec3 colour;
out vec4 pixel;
void main() { pixel = vec4(colour, 1.0); }`;

// bytes of a tile of the surface as the API sends them: place in the tile, times seen; session, age
const CELLS = `#version 300 es
layout(location = 0) in uvec4 place;
layout(location = 1) in uvec2 last;
uniform mat4 model, clip;
uniform vec3 above, unknown;
uniform vec2 pixels, heights, cut, ages;
uniform float span, size, most; // metres of the tile; pixels at one metre; greatest of times seen
uniform int mode;
uniform sampler2D palette;
flat out vec3 colour;

${RAMP}

void main() {
  vec4 world = model * vec4((vec3(place.xyz) + 0.5) / 256.0 * span, 1.0);
  float height = dot(world.xyz, above);
  gl_Position = clip * world;
  gl_PointSize = clamp(size / max(gl_Position.w, 1e-6), pixels.x, pixels.y);
  if (height < cut.x || height > cut.y) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  float share = clamp((height - heights.x) / max(heights.y - heights.x, 1e-6), 0.0, 1.0);
  if (mode == 0) colour = ramped(share);
  else if (mode == 1) { // what is lower is darker: one colour alone has no shape
    colour = last.x == 65535u ? unknown : texelFetch(palette, ivec2(int(last.x & 255u), int(last.x >> 8)), 0).rgb;
    colour *= 0.6 + 0.4 * share;
  }
  else if (mode == 2) colour = ramped((float(place.w) - 16.0) / max(most - 16.0, 1.0));
  else colour = last.y == 65535u ? unknown : ramped((float(last.y) - ages.x) / max(ages.y - ages.x, 1.0));
}`;

// a segment is a strip of four corners, moved off its axis by half its width on the screen
const LINES = `#version 300 es
layout(location = 0) in vec3 from;
layout(location = 1) in vec3 to;
layout(location = 2) in vec3 fromColour;
layout(location = 3) in vec3 toColour;
uniform mat4 model, clip;
uniform vec2 screen; // pixels
uniform float width;
uniform vec4 tint;   // a: 1 where it holds, 0 where each end has its colour
out vec3 colour;

void main() {
  vec4 a = clip * (model * vec4(from, 1.0)), b = clip * (model * vec4(to, 1.0));
  const float near = 1e-4;
  bool second = (gl_VertexID & 2) != 0;
  float side = (gl_VertexID & 1) == 0 ? -0.5 : 0.5;
  colour = mix(second ? toColour : fromColour, tint.rgb, tint.a);
  if (a.w < near && b.w < near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * screen;
  float run = length(along);
  vec2 across = run > 1e-6 ? vec2(-along.y, along.x) / run : vec2(0.0, 1.0);
  vec4 end = second ? b : a;
  gl_Position = end + vec4(across * side * width * 2.0 / screen * end.w, 0.0, 0.0);
}`;

const LINE_COLOUR = `#version 300 es
precision mediump float;
in vec3 colour;
out vec4 pixel;
void main() { pixel = vec4(colour, 1.0); }`;

const TRIANGLES = `#version 300 es
layout(location = 0) in vec3 at;
layout(location = 1) in vec3 own;
uniform mat4 model, clip;
uniform vec4 tint;
out vec3 colour;
void main() {
  gl_Position = clip * (model * vec4(at, 1.0));
  colour = mix(own, tint.rgb, tint.a);
}`;

const TRIANGLE_COLOUR = `#version 300 es
precision mediump float;
in vec3 colour;
uniform float alpha;
out vec4 pixel;
void main() { pixel = vec4(colour * alpha, alpha); }`;

function linked(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(made).map((one) => gl.getShaderInfoLog(one));
    throw new Error(`A shader does not compile: ${[gl.getProgramInfoLog(made), ...logs].join(" ")}`);
  }
  const at = {};
  const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) ?? 0;
  for (let i = 0; i < count; i += 1) {
    const name = gl.getActiveUniform(made, i).name.replace("[0]", "");
    at[name] = gl.getUniformLocation(made, name);
  }
  return { made, at };
}

const SOURCES = {
  points: [POINTS, POINT_COLOUR], cells: [CELLS, POINT_COLOUR], lines: [LINES, LINE_COLOUR],
  triangles: [TRIANGLES, TRIANGLE_COLOUR],
};

/** A program of a context, with the places of its uniforms. @param {any} gl
 * @param {keyof typeof SOURCES} kind @returns {{made: WebGLProgram, at: Object<string, any>}} */
export const program = (gl, kind) => linked(gl, ...SOURCES[kind]);
