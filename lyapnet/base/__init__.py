"""What everything else rests on: errors, files, shapes, small matrices, tables; knows no control."""
