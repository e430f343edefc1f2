package integrate;

import com.google.rpc.ErrorInfo;
import io.grpc.Status;
import io.grpc.StatusException;
import io.grpc.stub.BlockingClientCall;
import java.io.IOException;
import java.nio.file.Files;
import java.nio.file.Path;
import java.nio.file.StandardCopyOption;
import java.nio.file.StandardOpenOption;
import java.time.Duration;
import java.util.HashMap;
import java.util.Map;
import java.util.Optional;
import revisit.v1.CandidateEvent;
import revisit.v1.Check;
import revisit.v1.CheckCandidate;
import revisit.v1.ListChecksRequest;
import revisit.v1.ListChecksResponse;
import revisit.v1.PoseGraphServiceGrpc.PoseGraphServiceBlockingV2Stub;
import revisit.v1.VehicleDeleted;
import revisit.v1.WatchCandidatesRequest;
import revisit.v1.WatchCandidatesResponse;

/**
 * Prints what becomes of stored candidates, and goes on where it was after whatever broke, this
 * program too: a file keeps the cursor of what was worked off.
 */
final class CandidateWatcher {
  private static final Duration SOON = Duration.ofMillis(100);

  private final PoseGraphServiceBlockingV2Stub stub;
  private final Path path;
  // By uid of the vehicle: the number of its last event that was worked off.
  private final Map<String, Long> told = new HashMap<>();
  private int attempt = 0;

  CandidateWatcher(PoseGraphServiceBlockingV2Stub stub, Path path) {
    this.stub = stub;
    this.path = path;
  }

  /** Watches until an error comes that another attempt does not mend. */
  void run() throws StatusException, InterruptedException, IOException {
    while (true) {
      try {
        watchOnce();
      } catch (StatusException error) {
        String reason = Details.of(error).info().map(ErrorInfo::getReason).orElse("");
        Optional<Duration> wait = Details.waitBeforeRetry(error, ++attempt);
        switch (reason) {
          case "CURSOR_TOO_OLD", "CURSOR_UNKNOWN" -> {
            Files.delete(path);
            wait = Optional.of(SOON);
          }
          case "SLOW_CONSUMER" -> wait = Optional.of(SOON);
          default -> {}
        }
        if (wait.isEmpty()) {
          throw error;
        }
        System.out.printf(
            "watch: lost (%s), again in %.1f s%n",
            reason.isEmpty() ? error.getStatus().getCode() : reason, wait.get().toMillis() / 1e3);
        Thread.sleep(wait.get().toMillis());
      }
    }
  }

  /** Works off what one call tells. */
  private void watchOnce() throws StatusException, InterruptedException, IOException {
    if (Files.notExists(path)) {
      // The events of a store that was restored from a backup have lower numbers.
      told.clear();
      keep(listAll());
    }
    BlockingClientCall<?, WatchCandidatesResponse> call =
        stub.watchCandidates(
            WatchCandidatesRequest.newBuilder().setCursor(Files.readString(path)).build());
    try {
      WatchCandidatesResponse answer;
      while ((answer = call.read()) != null) {
        take(answer);
        keep(answer.getCursor());
        attempt = 0;
      }
    } finally {
      call.cancel("the watch is over", null);
    }
    // A watch never ends by itself.
    throw Status.UNAVAILABLE.withDescription("the server ended the watch").asException();
  }

  /** Prints what is stored, and returns the cursor from which a watch goes on. */
  private String listAll() throws StatusException {
    ListChecksRequest.Builder request = ListChecksRequest.newBuilder().setParent("vehicles/-");
    String cursor = "";
    do {
      ListChecksResponse page = stub.listChecks(request.build());
      if (cursor.isEmpty()) {
        // Only the first page has it.
        cursor = page.getWatchCursor();
      }
      for (Check check : page.getChecksList()) {
        for (CheckCandidate candidate : check.getStatesList()) {
          System.out.printf("listed: %s%n", textOf(candidate));
        }
      }
      request.setPageToken(page.getNextPageToken());
    } while (!request.getPageToken().isEmpty());
    return cursor;
  }

  private void take(WatchCandidatesResponse answer) {
    switch (answer.getEventCase()) {
      case CANDIDATE -> {
        CandidateEvent event = answer.getCandidate();
        workOff(event.getVehicleUid(), event.getNumber(), textOf(event.getCandidate()));
      }
      case VEHICLE_DELETED -> {
        VehicleDeleted event = answer.getVehicleDeleted();
        workOff(event.getVehicleUid(), event.getNumber(), event.getVehicle() + " DELETED");
      }
      default -> {
        // A beat only moves the cursor.
      }
    }
  }

  /**
   * This is where a verifier works. What it does comes to the same if done twice: an event comes
   * again if the program ends before its cursor is kept.
   */
  private void workOff(String vehicleUid, long number, String text) {
    if (number > told.getOrDefault(vehicleUid, 0L)) {
      System.out.printf("event: %d %s%n", number, text);
      told.put(vehicleUid, number);
    }
  }

  private static String textOf(CheckCandidate candidate) {
    return candidate.getName()
        + " "
        + candidate.getState().name().replace("CANDIDATE_STATE_", "");
  }

  /** Replaces the file, so that it is never without a cursor. */
  private void keep(String cursor) throws IOException {
    Path partial = path.resolveSibling(path.getFileName() + ".partial");
    Files.writeString(
        partial, cursor,
        StandardOpenOption.CREATE, StandardOpenOption.TRUNCATE_EXISTING,
        StandardOpenOption.WRITE, StandardOpenOption.SYNC);
    Files.move(partial, path, StandardCopyOption.ATOMIC_MOVE);
  }
}
