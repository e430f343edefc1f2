//! A watch that outlives its connection, and this program.

use std::{
    collections::HashMap,
    error::Error,
    fs::{self, File},
    io::{self, Write},
    path::PathBuf,
    time::Duration,
};

use tonic::{transport::Channel, Status};
use tonic_types::StatusExt;

use crate::revisit::v1::{
    pose_graph_service_client::PoseGraphServiceClient, watch_candidates_response::Event,
    CheckCandidate, ListChecksRequest, WatchCandidatesRequest,
};
use crate::{code_name, retry::wait_before_retry};

const SOON: Duration = Duration::from_millis(100);

/// Prints what becomes of stored candidates, and goes on where it was after whatever
/// broke.
pub struct CandidateWatcher {
    client: PoseGraphServiceClient<Channel>,
    /// The file that keeps the cursor of what was worked off.
    path: PathBuf,
    /// By uid of the vehicle: the number of its last event that was worked off.
    told: HashMap<String, u64>,
    attempt: u32,
}

impl CandidateWatcher {
    pub fn new(client: PoseGraphServiceClient<Channel>, path: impl Into<PathBuf>) -> Self {
        Self {
            client,
            path: path.into(),
            told: HashMap::new(),
            attempt: 0,
        }
    }

    /// Watches until an error comes that another attempt does not mend.
    pub async fn run(mut self) -> Result<(), Box<dyn Error>> {
        loop {
            let error = match self.watch_once().await {
                Err(error) => *error.downcast::<Status>()?,
                // A watch never ends by itself.
                Ok(()) => Status::unavailable("the server ended the watch"),
            };
            self.attempt += 1;
            let reason = error.get_details_error_info().map(|info| info.reason);
            let wait = match reason.as_deref() {
                Some("CURSOR_TOO_OLD" | "CURSOR_UNKNOWN") => {
                    fs::remove_file(&self.path)?;
                    Some(SOON)
                }
                Some("SLOW_CONSUMER") => Some(SOON),
                _ => wait_before_retry(&error, self.attempt),
            };
            let Some(wait) = wait else {
                return Err(error.into());
            };
            println!(
                "watch: lost ({}), again in {:.1} s",
                reason.unwrap_or_else(|| code_name(error.code())),
                wait.as_secs_f64()
            );
            tokio::time::sleep(wait).await;
        }
    }

    /// Works off what one call tells.
    async fn watch_once(&mut self) -> Result<(), Box<dyn Error>> {
        if !self.path.try_exists()? {
            // The events of a store that was restored from a backup have lower numbers.
            self.told.clear();
            let cursor = self.list_all().await?;
            self.keep(&cursor)?;
        }
        let request = WatchCandidatesRequest {
            cursor: fs::read_to_string(&self.path)?,
            ..Default::default()
        };
        let mut answers = self.client.watch_candidates(request).await?.into_inner();
        while let Some(answer) = answers.message().await? {
            if let Some(event) = answer.event {
                self.take(event);
            }
            self.keep(&answer.cursor)?;
            self.attempt = 0;
        }
        Ok(())
    }

    /// Prints what is stored, and returns the cursor from which a watch goes on.
    async fn list_all(&mut self) -> Result<String, Status> {
        let mut request = ListChecksRequest {
            parent: "vehicles/-".into(),
            ..Default::default()
        };
        let mut cursor = String::new();
        loop {
            let page = self.client.list_checks(request.clone()).await?.into_inner();
            if request.page_token.is_empty() {
                cursor = page.watch_cursor;
            }
            for candidate in page.checks.iter().flat_map(|check| &check.states) {
                println!("listed: {}", text_of(candidate));
            }
            if page.next_page_token.is_empty() {
                return Ok(cursor);
            }
            request.page_token = page.next_page_token;
        }
    }

    /// This is where a verifier works. What it does comes to the same if done twice: an
    /// event comes again if the program ends before its cursor is kept.
    fn take(&mut self, event: Event) {
        let (vehicle_uid, number, text) = match event {
            Event::Candidate(event) => (
                event.vehicle_uid,
                event.number,
                text_of(&event.candidate.unwrap_or_default()),
            ),
            Event::VehicleDeleted(event) => (
                event.vehicle_uid,
                event.number,
                format!("{} DELETED", event.vehicle),
            ),
            // Only moves the cursor.
            Event::Beat(_) => return,
        };
        let told = self.told.entry(vehicle_uid).or_default();
        if number > *told {
            println!("event: {number} {text}");
            *told = number;
        }
    }

    /// Replaces the file, so that it is never without a cursor.
    fn keep(&self, cursor: &str) -> io::Result<()> {
        let mut partial = self.path.clone().into_os_string();
        partial.push(".partial");
        let mut file = File::create(&partial)?;
        file.write_all(cursor.as_bytes())?;
        file.sync_all()?;
        fs::rename(&partial, &self.path)
    }
}

fn text_of(candidate: &CheckCandidate) -> String {
    let state = candidate.state().as_str_name();
    format!(
        "{} {}",
        candidate.name,
        state.trim_start_matches("CANDIDATE_STATE_")
    )
}
