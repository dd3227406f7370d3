"""One page of everything that was reproduced, beside what the paper says: `hiernav report`."""
