"""The paper's tables and figures beside ours: what can be reproduced without its hardware."""
