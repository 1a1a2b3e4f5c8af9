"""What comes from elsewhere and goes elsewhere: imported laws, exported ones, a page to look at."""
