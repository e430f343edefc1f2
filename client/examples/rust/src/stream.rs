//! A stream that outlives its connection.

use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{transport::Channel, Code, Status};

use crate::revisit::v1::{
    pose_graph_service_client::PoseGraphServiceClient, stream_poses_request::Message as Request,
    stream_poses_response::Message as Answer, Candidate, CandidateSet, Node, Pose, PoseBatch,
    StreamPosesOpen, StreamPosesRequest, Vehicle, Verdict,
};
use crate::{code_name, drive::columns_of, retry::wait_before_retry};

const BATCH: usize = 64;

/// Streams poses until all are durable, over as many connections as it takes.
pub struct PoseStreamer<'a> {
    client: PoseGraphServiceClient<Channel>,
    poses: &'a [Pose],
    /// Whoever outlives this program keeps uid and acked sequence, beside the poses.
    opening: StreamPosesOpen,
    accepted: Vec<Candidate>,
    attempt: u32,
}

impl<'a> PoseStreamer<'a> {
    pub fn new(
        client: PoseGraphServiceClient<Channel>,
        vehicle: &Vehicle,
        poses: &'a [Pose],
    ) -> Self {
        let opening = StreamPosesOpen {
            vehicle: vehicle.name.clone(),
            vehicle_uid: vehicle.uid.clone(),
            send_candidates: true,
            ..Default::default()
        };
        Self {
            client,
            poses,
            opening,
            accepted: Vec::new(),
            attempt: 0,
        }
    }

    /// Streams all, and returns the accepted candidates that came.
    pub async fn run(mut self) -> Result<Vec<Candidate>, Status> {
        while let Err(error) = self.stream_once().await {
            self.attempt += 1;
            let Some(wait) = wait_before_retry(&error, self.attempt) else {
                return Err(error);
            };
            println!(
                "stream: lost at {} ({}), again in {:.1} s",
                self.opening.acked_sequence,
                code_name(error.code()),
                wait.as_secs_f64()
            );
            tokio::time::sleep(wait).await;
        }
        Ok(self.accepted)
    }

    /// Sends what is not durable yet over one stream, while it takes the answers.
    async fn stream_once(&mut self) -> Result<(), Status> {
        let (sender, requests) = mpsc::channel(4);
        let open = request(Request::Open(self.opening.clone()));
        sender.try_send(open).expect("there is room for one");
        let mut sender = Some(sender);
        let mut answers = self
            .client
            .stream_poses(ReceiverStream::new(requests))
            .await?
            .into_inner();
        while let Some(answer) = answers.message().await? {
            match answer.message {
                Some(Answer::Opened(opened)) => {
                    self.opening.acked_sequence = opened.durable_sequence;
                    println!("stream: open, durable up to {}", opened.durable_sequence);
                    if let Some(sender) = sender.take() {
                        let rest = &self.poses[opened.durable_sequence as usize..];
                        tokio::spawn(send(sender, rest.to_vec(), opened.takes_pose_columns));
                    }
                }
                Some(Answer::Ack(ack)) => {
                    self.opening.acked_sequence = ack.durable_sequence;
                    self.attempt = 0;
                }
                Some(Answer::Candidates(set)) => self.report(set),
                None => return Err(Status::new(Code::DataLoss, "an answer without content")),
            }
        }
        Ok(())
    }

    /// Prints and keeps the candidates that are worth a verifier's look.
    fn report(&mut self, set: CandidateSet) {
        for candidate in set.candidates {
            if candidate.verdict() == Verdict::Accepted {
                println!(
                    "candidate: {} is {}, probability {:.3}",
                    place(&candidate.query),
                    place(&candidate.matched),
                    candidate.probability()
                );
                self.accepted.push(candidate);
            }
        }
    }
}

/// Sends the poses, no faster than the server reads them. Once the sender is dropped,
/// the stream is half-closed.
async fn send(sender: mpsc::Sender<StreamPosesRequest>, poses: Vec<Pose>, takes_columns: bool) {
    for part in poses.chunks(BATCH) {
        let mut batch = PoseBatch::default();
        if takes_columns {
            batch.columns = Some(columns_of(part));
        } else {
            // Servers that know no columns take the same poses as messages.
            batch.poses = part.to_vec();
        }
        if sender.send(request(Request::Batch(batch))).await.is_err() {
            return; // The stream is over.
        }
    }
}

fn request(message: Request) -> StreamPosesRequest {
    StreamPosesRequest {
        message: Some(message),
    }
}

fn place(node: &Option<Node>) -> String {
    let node = node.clone().unwrap_or_default();
    format!("{} at {}", node.sequence, node.stamp.unwrap_or_default())
}
