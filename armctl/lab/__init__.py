"""Work on simulated and real arms: demonstration, rehearsal of logs, the straight line and its correction, studies."""
