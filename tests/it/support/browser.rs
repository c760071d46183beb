//! Chromium without a window, steered by the DevTools protocol over pipes.

use std::{process::Stdio, time::Duration};

use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::{
    io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader},
    process::{Child, ChildStdin, ChildStdout, Command},
    time::timeout,
};

use super::eventually::PATIENCE;

/// Names that the browser goes by.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "chrome"];

/// The program, if one is installed.
pub fn find() -> Option<&'static str> {
    let works = |name: &&str| {
        let mut command = std::process::Command::new(name);
        let status = command.arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
        status.is_ok_and(|status| status.success())
    };
    NAMES.into_iter().find(works)
}

/// One page in a browser with a profile of its own.
pub struct Page {
    // Ends with the page.
    _browser: Child,
    _profile: TempDir,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    session: Option<String>,
    last: u64,
    /// Addresses that the page asked for.
    pub requests: Vec<String>,
    /// Exceptions of its scripts, and what its policy or a request went wrong with.
    pub faults: Vec<String>,
}

impl Page {
    /// Starts `program`, without a GPU, and opens `url`.
    pub async fn open(program: &str, url: &str) -> Self {
        Self::open_with(program, &["--disable-gpu"], url).await
    }

    /// As [`Page::open`], with flags of the browser.
    pub async fn open_with(program: &str, flags: &[&str], url: &str) -> Self {
        Self::open_after(program, flags, "", url).await
    }

    /// As [`Page::open_with`], with a script that runs before those of the page.
    pub async fn open_after(program: &str, flags: &[&str], script: &str, url: &str) -> Self {
        let profile = tempfile::tempdir().expect("a folder");
        // It reads commands at 3 and answers at 4, with a zero byte behind each.
        let mut command = Command::new("sh");
        command.args(["-c", r#"exec "$@" 3<&0 4>&1 </dev/null >/dev/null"#, "sh", program]);
        command.args(["--headless", "--no-sandbox", "--disable-dev-shm-usage"]);
        command.args(flags);
        command.args(["--no-first-run", "--remote-debugging-pipe"]);
        command.arg(format!("--user-data-dir={}", profile.path().display()));
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).kill_on_drop(true);
        let mut browser = command.spawn().expect("a shell");
        let to = browser.stdin.take().expect("piped");
        let from = BufReader::new(browser.stdout.take().expect("piped"));
        let mut page = Self {
            _browser: browser,
            _profile: profile,
            to,
            from,
            session: None,
            last: 0,
            requests: Vec::new(),
            faults: Vec::new(),
        };
        let target = page.ask("Target.createTarget", json!({ "url": "about:blank" })).await;
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let attached = page.ask("Target.attachToTarget", attach).await;
        page.session = attached["sessionId"].as_str().map(str::to_owned);
        for domain in ["Page", "Runtime", "Network", "Log"] {
            page.ask(&format!("{domain}.enable"), json!({})).await;
        }
        page.ask("Page.addScriptToEvaluateOnNewDocument", json!({ "source": script })).await;
        page.ask("Page.navigate", json!({ "url": url })).await;
        page
    }

    /// Sends one command and returns its result; events that come before it are kept.
    pub async fn ask(&mut self, method: &str, parameters: Value) -> Value {
        self.last += 1;
        let mut message = json!({ "id": self.last, "method": method, "params": parameters });
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.to.write_all(format!("{message}\0").as_bytes()).await.expect("the browser listens");
        loop {
            let mut answer = Vec::new();
            let read = timeout(PATIENCE, self.from.read_until(0, &mut answer)).await;
            let count = read.unwrap_or_else(|_| panic!("no answer to {method}")).expect("readable");
            assert!(count > 0, "the browser has ended");
            answer.pop();
            let answer: Value = serde_json::from_slice(&answer).expect("JSON");
            if answer["id"] == self.last {
                assert!(answer["error"].is_null(), "{method}: {answer}");
                return answer["result"].clone();
            }
            self.note(&answer);
        }
    }

    fn note(&mut self, event: &Value) {
        let parameters = &event["params"];
        match event["method"].as_str() {
            Some("Network.requestWillBeSent") => {
                self.requests.push(parameters["request"]["url"].as_str().unwrap_or_default().to_owned());
            }
            Some("Runtime.exceptionThrown") => self.faults.push(parameters["exceptionDetails"].to_string()),
            Some("Log.entryAdded") if parameters["entry"]["level"] == "error" => {
                self.faults.push(parameters["entry"].to_string());
            }
            _ => {}
        }
    }

    /// What an expression in the page comes to.
    pub async fn evaluate(&mut self, expression: &str) -> Value {
        let asked = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let answer = self.ask("Runtime.evaluate", asked).await;
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {answer}");
        answer["result"]["value"].clone()
    }

    /// Evaluates until the value is as wanted.
    pub async fn until(&mut self, expression: &str, mut wanted: impl FnMut(&Value) -> bool) -> Value {
        let mut last = Value::Null;
        let wait = async {
            loop {
                last = self.evaluate(expression).await;
                if wanted(&last) {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        let done = timeout(PATIENCE, wait).await.is_ok();
        assert!(done, "{expression} stays {last}; faults: {:?}", self.faults);
        last
    }

    /// What a mouse does, with its left button down or not.
    pub async fn mouse(&mut self, what: &str, x: f64, y: f64) {
        let event = json!({ "type": what, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1 });
        self.ask("Input.dispatchMouseEvent", event).await;
    }

    /// Presses and releases a key.
    pub async fn key(&mut self, name: &str) {
        for what in ["keyDown", "keyUp"] {
            self.ask("Input.dispatchKeyEvent", json!({ "type": what, "key": name, "code": name })).await;
        }
    }

    /// Gives the page a window of this size.
    pub async fn resize(&mut self, width: u32, height: u32) {
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false });
        self.ask("Emulation.setDeviceMetricsOverride", metrics).await;
    }

    /// Takes the page for a phone's, with fingers.
    pub async fn be_a_phone(&mut self) {
        let metrics = json!({ "width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": true });
        self.ask("Emulation.setDeviceMetricsOverride", metrics).await;
        self.ask("Emulation.setTouchEmulationEnabled", json!({ "enabled": true, "maxTouchPoints": 2 })).await;
    }

    /// What fingers do; each is where it stands.
    pub async fn touch(&mut self, what: &str, fingers: &[(f64, f64)]) {
        let points: Vec<Value> =
            fingers.iter().enumerate().map(|(id, (x, y))| json!({ "x": x, "y": y, "id": id })).collect();
        self.ask("Input.dispatchTouchEvent", json!({ "type": what, "touchPoints": points })).await;
    }
}
