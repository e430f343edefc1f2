package integrate;

import io.grpc.StatusException;
import io.grpc.stub.BlockingClientCall;
import java.time.Duration;
import java.time.Instant;
import java.util.ArrayList;
import java.util.List;
import java.util.Optional;
import revisit.v1.Candidate;
import revisit.v1.CandidateSet;
import revisit.v1.Node;
import revisit.v1.Pose;
import revisit.v1.PoseBatch;
import revisit.v1.PoseGraphServiceGrpc.PoseGraphServiceBlockingV2Stub;
import revisit.v1.StreamPosesOpen;
import revisit.v1.StreamPosesRequest;
import revisit.v1.StreamPosesResponse;
import revisit.v1.Vehicle;
import revisit.v1.Verdict;

/** Streams poses until all are durable, over as many connections as it takes. */
final class PoseStreamer {
  private static final int BATCH = 64;

  private final PoseGraphServiceBlockingV2Stub stub;
  private final List<Pose> poses;
  private final List<Candidate> accepted = new ArrayList<>();
  // Whoever outlives this program keeps uid and acked sequence, beside the poses.
  private final StreamPosesOpen.Builder opening;
  private int attempt = 0;

  PoseStreamer(PoseGraphServiceBlockingV2Stub stub, Vehicle vehicle, List<Pose> poses) {
    this.stub = stub;
    this.poses = poses;
    this.opening =
        StreamPosesOpen.newBuilder()
            .setVehicle(vehicle.getName())
            .setVehicleUid(vehicle.getUid())
            .setSendCandidates(true);
  }

  /** Streams all, and returns the accepted candidates that came. */
  List<Candidate> run() throws StatusException, InterruptedException {
    while (true) {
      try {
        streamOnce();
        return accepted;
      } catch (StatusException error) {
        Optional<Duration> wait = Details.waitBeforeRetry(error, ++attempt);
        if (wait.isEmpty()) {
          throw error;
        }
        System.out.printf(
            "stream: lost at %d (%s), again in %.1f s%n",
            opening.getAckedSequence(), error.getStatus().getCode(), wait.get().toMillis() / 1e3);
        Thread.sleep(wait.get().toMillis());
      }
    }
  }

  /** Sends what is not durable yet over one stream, while it takes the answers. */
  private void streamOnce() throws StatusException, InterruptedException {
    BlockingClientCall<StreamPosesRequest, StreamPosesResponse> call = stub.streamPoses();
    Thread sender = null;
    try {
      call.write(StreamPosesRequest.newBuilder().setOpen(opening).build());
      StreamPosesResponse answer;
      while ((answer = call.read()) != null) {
        if (answer.hasOpened()) {
          int next = (int) answer.getOpened().getDurableSequence();
          boolean takesColumns = answer.getOpened().getTakesPoseColumns();
          sender = new Thread(() -> send(call, poses.subList(next, poses.size()), takesColumns));
          sender.start();
        }
        take(answer);
      }
    } finally {
      call.cancel("the stream is over", null);
      if (sender != null) {
        sender.join();
      }
    }
  }

  /** Sends the poses, no faster than the server reads them. */
  private static void send(
      BlockingClientCall<StreamPosesRequest, StreamPosesResponse> call,
      List<Pose> poses,
      boolean takesColumns) {
    try {
      for (int first = 0; first < poses.size(); first += BATCH) {
        List<Pose> part = poses.subList(first, Math.min(first + BATCH, poses.size()));
        PoseBatch.Builder batch = PoseBatch.newBuilder();
        if (takesColumns) {
          batch.setColumns(Drive.columnsOf(part));
        } else {
          // Servers that know no columns take the same poses as messages.
          batch.addAllPoses(part);
        }
        if (!call.write(StreamPosesRequest.newBuilder().setBatch(batch).build())) {
          return;
        }
      }
      call.halfClose();
    } catch (StatusException | InterruptedException | IllegalStateException over) {
      // The reading thread has the error of the call.
    }
  }

  private void take(StreamPosesResponse answer) {
    switch (answer.getMessageCase()) {
      case OPENED -> {
        opening.setAckedSequence(answer.getOpened().getDurableSequence());
        System.out.printf("stream: open, durable up to %d%n", opening.getAckedSequence());
      }
      case ACK -> {
        opening.setAckedSequence(answer.getAck().getDurableSequence());
        attempt = 0;
      }
      default -> report(answer.getCandidates());
    }
  }

  /** Prints and keeps the candidates that are worth a verifier's look. */
  private void report(CandidateSet set) {
    for (Candidate candidate : set.getCandidatesList()) {
      if (candidate.getVerdict() == Verdict.VERDICT_ACCEPTED) {
        System.out.printf(
            "candidate: %s is %s, probability %.3f%n",
            place(candidate.getQuery()), place(candidate.getMatched()),
            candidate.getProbability());
        accepted.add(candidate);
      }
    }
  }

  private static String place(Node node) {
    return node.getSequence()
        + " at "
        + Instant.ofEpochSecond(node.getStamp().getSeconds(), node.getStamp().getNanos());
  }
}
