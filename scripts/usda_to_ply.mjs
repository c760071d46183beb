// usda_to_ply.mjs IN.json OUT.ply: what read_usda.py prints, as the .ply that viewers read.
import { readFileSync, writeFileSync } from "node:fs";

const [input, output] = process.argv.slice(2);
const { degree, positions, scales, opacities, orientations, coefficients } = JSON.parse(readFileSync(input));
const count = opacities.length;
const functions = (degree + 1) ** 2;
const rest = 3 * (functions - 1);
const names = [
  "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", ...Array.from({ length: rest }, (_, k) => `f_rest_${k}`),
  "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
];
const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${count}\n`
  + names.map((name) => `property float ${name}\n`).join("") + "end_header\n";
const rows = new Float32Array(count * names.length);
for (let i = 0; i < count; i++) {
  const color = (k, channel) => coefficients[3 * (i * functions + k) + channel];
  const [x, y, z, w] = orientations.slice(4 * i, 4 * i + 4);
  const row = [
    ...positions.slice(3 * i, 3 * i + 3),
    ...[0, 1, 2].map((channel) => color(0, channel)),
    // Channel by channel.
    ...Array.from({ length: rest }, (_, k) => color(1 + (k % (functions - 1)), Math.floor(k / (functions - 1)))),
    Math.log(opacities[i] / (1 - opacities[i])),
    ...scales.slice(3 * i, 3 * i + 3).map(Math.log),
    w, x, y, z,
  ];
  rows.set(row, i * names.length);
}
writeFileSync(output, Buffer.concat([Buffer.from(header), Buffer.from(rows.buffer)]));
