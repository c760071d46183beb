// viewer_pictures.mjs FOLDER PLAYCANVAS CHROMIUM: serves FOLDER, whose list.json names files, cameras and pictures by tcgs, to a page that
// draws the files with PlayCanvas in a headless Chromium, on WebGL2 of the processor. Writes FOLDER/NAME_CAMERA.png, and prints the mean
// PSNR of each file's pictures to those by tcgs.
import { spawn } from "node:child_process";
import { createReadStream, existsSync, mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { tmpdir } from "node:os";
import { basename, dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const [folder, playcanvas, chromium] = process.argv.slice(2);
const LIMIT_SECONDS = Number(process.env.TCGS_PICTURES_SECONDS ?? 600);
const here = dirname(fileURLToPath(import.meta.url));
const types = { html: "text/html", mjs: "text/javascript", json: "application/json", png: "image/png" };
const results = new Map();
let browser, profile;

function end(code, message) {
  if (message) console.error(`viewer_pictures: ${message}`);
  browser?.kill("SIGKILL");
  browser?.once("exit", () => {
    rmSync(profile, { recursive: true, force: true, maxRetries: 5 });
    process.exit(code);
  });
}

function body(request) {
  return new Promise((done) => {
    const parts = [];
    request.on("data", (part) => parts.push(part));
    request.on("end", () => done(Buffer.concat(parts)));
  });
}

const mean = (values) => (values.includes(null) ? "-" : (values.reduce((a, b) => a + b, 0) / values.length).toFixed(2));

async function received(path, content) {
  if (path === "/done") {
    console.log("drawn from\tdB to the scene\tdB to tcgs's picture of the .ply");
    for (const [name, { scene, plain }] of results) console.log(`${name}\t${mean(scene)}\t${mean(plain)}`);
    end(0);
  } else if (path === "/failed") {
    end(1, JSON.parse(content).error);
  } else if (path === "/figure") {
    const { name, scene, plain } = JSON.parse(content);
    const kept = results.get(name) ?? { scene: [], plain: [] };
    results.set(name, { scene: [...kept.scene, scene], plain: [...kept.plain, plain] });
  } else {
    const [, , name, camera] = path.split("/").map((part) => basename(part));
    writeFileSync(join(folder, `${name}_${camera}.png`), content);
  }
}

const server = createServer(async (request, response) => {
  const { pathname } = new URL(request.url, "http://localhost");
  if (request.method === "POST") {
    const content = await body(request);
    response.end();
    await received(pathname, content);
    return;
  }
  const file = {
    "/": join(here, "viewer_pictures.html"),
    "/playcanvas.mjs": playcanvas,
  }[pathname] ?? join(folder, basename(pathname));
  if (!existsSync(file)) {
    response.writeHead(404).end();
    return;
  }
  response.setHeader("content-type", types[file.split(".").pop()] ?? "application/octet-stream");
  createReadStream(file).pipe(response);
});

server.listen(0, "127.0.0.1", () => {
  profile = mkdtempSync(join(tmpdir(), "viewer-pictures-"));
  const flags = [
    "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run",
    "--disable-quic", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--force-device-scale-factor=1", "--force-color-profile=srgb", `--user-data-dir=${profile}`,
  ];
  browser = spawn(chromium, [...flags, `http://127.0.0.1:${server.address().port}/`], { stdio: "ignore" });
  browser.on("error", (error) => end(4, error.message));
  setTimeout(() => end(1, `no end within ${LIMIT_SECONDS} seconds`), LIMIT_SECONDS * 1000);
});
